"""The part of structure from motion that runs in a process of its own: reads a job, calls pycolmap, writes models.

Run as a script, with the job's path. It imports nothing of the package and no other library: pycolmap brings its own
copies of libraries that torch and Pillow bring too, and the process aborts where two of them meet.
"""

import json
import os
import sys
import threading
from pathlib import Path

LONGEST = 1600
"""Pixels of the longer side on which features are sought."""


def main(job_path: str) -> None:
    """Find the cameras of the job's images; models go to numbered folders, their image names to `result.json`."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    job = json.loads(Path(job_path).read_text(encoding="utf-8"))
    import pycolmap

    folder = Path(job["folder"])
    database, images = folder / "database.db", folder / "images"
    pycolmap.set_random_seed(job["seed"])
    _say("features")
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if job["masks"]:
        reader.mask_path = str(folder / "masks")
    extraction = pycolmap.FeatureExtractionOptions(num_threads=job["threads"], max_image_size=LONGEST)
    extraction.sift.max_num_features = job["features"]
    pycolmap.extract_features(
        database,
        images,
        image_names=job["names"],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    _say("matches")
    matching = pycolmap.FeatureMatchingOptions(num_threads=job["threads"])
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    match = pycolmap.match_exhaustive if job["exhaustive"] else pycolmap.match_sequential
    match(database, matching_options=matching, verification_options=verification, device=pycolmap.Device.cpu)
    _say("cameras")
    (folder / "models").mkdir()
    options = pycolmap.IncrementalPipelineOptions(num_threads=job["threads"], random_seed=job["seed"], min_model_size=3)
    options.mapper.random_seed = options.triangulation.random_seed = job["seed"]
    found = pycolmap.incremental_mapping(database, images, folder / "models", options=options)
    models = []
    for number, model in sorted(found.items()):
        # COLMAP reads no WebP: such images stand under another name in the job's folder.
        for image in model.images.values():
            image.name = job["true_names"].get(image.name, image.name)
        model.write(folder / "models" / str(number))
        # An image that a model merely knows of has no pose in it.
        names = sorted(image.name for image in model.images.values() if image.has_pose)
        models.append({"number": number, "names": names})
    (folder / "result.json").write_text(json.dumps(models), encoding="utf-8")


def _say(stage: str) -> None:
    """Write a line by which the parent knows how far the work is."""
    print(f"stage {stage}", flush=True)


def _die_with_parent() -> None:
    """End the process when the parent's end of the pipe closes, however the parent ended."""
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1])
    sys.stdout.flush()
    # All is written: nothing is gained by taking apart libraries that may fail at it.
    os._exit(0)
