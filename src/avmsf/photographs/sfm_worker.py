"""The part of structure from motion that runs in a process of its own: reads a job, calls pycolmap, writes models.

Run as a script, with the job's path. It imports nothing of the package and no other library: pycolmap brings its own
copies of libraries that torch and Pillow bring too, and the process aborts where two of them meet.
"""

import json
import os
import sys
import threading
from pathlib import Path

MAX_SIDE_PIXELS = 1600
"""Longer side of the images on which features are sought."""
MAX_ALL_PAIRS = 150
"""Images up to which every pair is matched; of more, each with the next ones in the order of their names."""


def main(job_path: Path) -> None:
    """Find the cameras of the images beside a job; models go to numbered folders, their image names to `result.json`.

    The job holds `names` (the true ones by those of the files), `features`, `seed` and `threads`.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    job, folder = json.loads(job_path.read_text(encoding="utf-8")), job_path.parent
    import pycolmap

    names, seed, threads = job["names"], job["seed"], job["threads"]
    database, images, masks, models = (folder / name for name in ("database.db", "images", "masks", "models"))
    pycolmap.set_random_seed(seed)
    # By these lines the parent knows how far the work is.
    print("stage features", flush=True)
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if masks.is_dir():
        reader.mask_path = str(masks)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, max_image_size=MAX_SIDE_PIXELS)
    extraction.sift.max_num_features = job["features"]
    pycolmap.extract_features(
        database,
        images,
        image_names=list(names),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    print("stage matches", flush=True)
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    match = pycolmap.match_exhaustive if len(names) <= MAX_ALL_PAIRS else pycolmap.match_sequential
    match(database, matching_options=matching, verification_options=verification, device=pycolmap.Device.cpu)
    print("stage cameras", flush=True)
    models.mkdir()
    options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=seed, min_model_size=3)
    options.mapper.random_seed = options.triangulation.random_seed = seed
    registered = {}
    for number, model in sorted(pycolmap.incremental_mapping(database, images, models, options=options).items()):
        for image in model.images.values():
            image.name = names.get(image.name, image.name)
        model.write(models / str(number))
        # An image that a model merely knows of has no pose in it.
        registered[number] = sorted(image.name for image in model.images.values() if image.has_pose)
    (folder / "result.json").write_text(json.dumps(registered), encoding="utf-8")


def _end_with_parent() -> None:
    """End the process when the parent's end of the pipe closes, however the parent ended."""
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
    sys.stdout.flush()
    # All is written: nothing is gained by taking apart libraries that may fail at it.
    os._exit(0)
