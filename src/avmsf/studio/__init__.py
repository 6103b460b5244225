"""The web page that plays, locates, edits and records, and its local server.

In goes what a user opens (`opening.open_target`): a field, a capture folder, pictures or a mesh; out come a page at a
secret address of this computer, impacts added to the capture folder, and edited fields saved to new files. Nothing is
served to other computers, other sites' pages or programs without the address (`guard`).

- `server`, `guard`, `responses`: HTTP with starlette and uvicorn; every refusal is one sentence and a status.
- `studio`: what the page can ask for; `session`: immutable revisions of the field, with undo.
- `files`: what the page fetches, in the format of `avmsf.export.web`, for the last few revisions.
- `edit`: the sliders, applied by `avmsf.editing.material.edit`; `locate`: the posterior of a contact, with tables made
  ahead of time.
- `capture`: impacts added to and removed from `impacts.csv`, atomically and under a lock.
- `jobs`, `worker`: fits and guided edits as a subprocess that speaks lines of JSON and ends when its standard input
  closes.
- `page/`: the page, JavaScript modules without a build step, with three.js and spark.

Start reading at `studio`, then `session` and `server`.
"""
