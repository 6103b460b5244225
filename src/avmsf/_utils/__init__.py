"""Private helpers shared by all packages, one idea a module; none imports another package of avmsf but `errors`.

What enters:

- `arrays`: lists, arrays and tensors that users give, as tensors of a known shape; seeds; one-line representations.
- `text`: text, JSON and TOML bounded in size and depth, and records whose fields have the types of an example.
- `headers`, `tensor_files`: safetensors files. A `FileKind` names the entry of a header, its formats and its errors;
  `read_tensors`, `write_tensors` and `TensorReader` (which checks types and sizes) do the rest. The header
  alone is read without torch, so that commands refuse a wrong file at once.

What is written:

- `files`: files and folders that are whole or as they were (a temporary name, then a rename).
- `checkpoint`: the state of work that may be interrupted.
- `caching`: files that only save time, and digests of the sources that a cached result depends on.
- `processes`: one writer at a time in a folder (`flock`), and child processes that end with their parent.
- `parallel`: tasks in processes of their own, on this computer or on a ray cluster, begun again where one is killed.

How it is computed: `compiled` (loops by numba, on several threads), `device` (CPU or GPU, denormals, threads), and
`progress` for those who wait.
"""
