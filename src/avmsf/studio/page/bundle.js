// The field as the page reads it: a manifest and its tensors, from files beside the page or from within it.

const FORMAT = 1;
/** Whether what was read last came from a studio, as a page that was exported does not. */
let live = false;
const ARRAYS = { float64: Float64Array, float32: Float32Array };

/** Return the URL of one of the page's files. A page that is one file carries them in `avmsfInlined`, as base64. */
function fileUrl(name) {
  const inlined = globalThis.avmsfInlined?.[name];
  if (inlined === undefined) return new URL(name, document.baseURI).href;
  if (inlined.url === undefined) {
    const bytes = Uint8Array.from(atob(inlined.base64), (letter) => letter.charCodeAt(0));
    inlined.url = URL.createObjectURL(new Blob([bytes], { type: inlined.type }));
    delete inlined.base64;
  }
  return inlined.url;
}

/**
 * Return {manifest, tensors, read(file)}: tensors by name (points, normals, frequency, damping, sine, cosine, noise) as
 * flat arrays, row by row; `read` gives the bytes of a file that the manifest names. Throws with words for the reader.
 */
export async function loadBundle() {
  const manifest = JSON.parse(new TextDecoder().decode(await read("manifest.json")));
  if (manifest.format !== FORMAT)
    throw new Error(`expected a field of format ${FORMAT}, got ${manifest.format}; export it again with this version`);
  live = Boolean(manifest.live);
  const files = {};
  const tensors = {};
  for (const [name, { file, offset, dtype, shape }] of Object.entries(manifest.tensors)) {
    files[file] ??= await read(file);
    tensors[name] = readTensor(files[file], offset, dtype, shape, `${file}: ${name}`);
  }
  // Modes that all start as sines have no cosines to send.
  tensors.cosine ??= new Float32Array(tensors.sine.length);
  return { manifest, tensors, read };
}

async function read(name) {
  const response = await fetch(fileUrl(name), { cache: "no-cache" }).catch(() => null);
  if (response?.ok) return response.arrayBuffer();
  const moved = "a restarted studio prints a new address: open it";
  if (response === null)
    throw new Error(`${name} cannot be loaded: check that the server runs${live ? `; ${moved}` : ""}`);
  throw new Error(`${name} cannot be read (${response.status}): ${live ? moved : "export the page again"}`);
}

function readTensor(buffer, offset, dtype, shape, what) {
  const count = shape.reduce((product, size) => product * size, 1);
  const kind = ARRAYS[dtype];
  if (kind === undefined) throw new Error(`${what} has the unknown type ${dtype}`);
  const bytes = kind.BYTES_PER_ELEMENT;
  if (offset + count * bytes > buffer.byteLength)
    throw new Error(`${what}: expected ${offset + count * bytes} bytes, got ${buffer.byteLength}; export the page again`);
  const tensor = new kind(buffer, offset, count);
  for (let place = 0; place < count; place++) {
    if (!Number.isFinite(tensor[place]))
      throw new Error(`${what}: expected numbers, got ${tensor[place]} at index ${place}; export the page again`);
  }
  return tensor;
}
