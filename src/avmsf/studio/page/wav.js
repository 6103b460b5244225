/** Recordings as WAV files: one channel of 32-bit floats, so that nothing is rounded or cut off on the way. */

export function encodeWav(samples, sampleRate) {
  const bytes = new ArrayBuffer(58 + 4 * samples.length);
  const view = new DataView(bytes);
  const write = (at, letters) =>
    [...letters].forEach((letter, place) => view.setUint8(at + place, letter.charCodeAt(0)));
  write(0, "RIFF");
  view.setUint32(4, bytes.byteLength - 8, true);
  write(8, "WAVEfmt ");
  view.setUint32(16, 18, true);
  view.setUint16(20, 3, true);
  view.setUint16(22, 1, true);
  view.setUint32(24, sampleRate, true);
  view.setUint32(28, 4 * sampleRate, true);
  view.setUint16(32, 4, true);
  view.setUint16(34, 32, true);
  view.setUint16(36, 0, true);
  // Formats other than integers state their number of samples as well.
  write(38, "fact");
  view.setUint32(42, 4, true);
  view.setUint32(46, samples.length, true);
  write(50, "data");
  view.setUint32(54, 4 * samples.length, true);
  samples.forEach((value, place) => view.setFloat32(58 + 4 * place, value, true));
  return new Blob([bytes], { type: "audio/wav" });
}

/** Throw the words to be said where a file does not begin as a WAV does; the server looks closer. */
export async function expectWav(file) {
  const head = new Uint8Array(await file.slice(0, 12).arrayBuffer());
  const letters = String.fromCharCode(...head);
  if (letters.startsWith("RIFF") && letters.endsWith("WAVE")) return;
  throw new Error(
    `${file.name}: expected a WAV file, got another kind; save the sound as WAV and choose it again.`,
  );
}
