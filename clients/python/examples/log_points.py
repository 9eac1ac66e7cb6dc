"""Finds points for a log without LiDAR: COLMAP matches its images and triangulates, with the poses of the log.

    pip install pycolmap
    wildcity log export LOG --out capture
    python log_points.py capture
    wildcity train LOG --points capture/points --out scene.ply

Reads capture/images and capture/sparse/0, and writes a COLMAP model to capture/points.
"""

import sys
from pathlib import Path

import pycolmap


def main(capture: Path) -> None:
    images, out = capture / "images", capture / "points"
    database = capture / "points.db"
    for path in (database, out):
        if path.exists():
            raise SystemExit(f"{path} is there: remove it first")
    posed = pycolmap.Reconstruction(capture / "sparse" / "0")
    # COLMAP writes a line for each image and each pair.
    pycolmap.logging.minloglevel = 1
    print("features", flush=True)
    with pycolmap.Database.open(database) as store:
        # With the numbers of the model, which the triangulation compares.
        for camera in posed.cameras.values():
            store.write_camera(camera, use_camera_id=True)
        for rig in posed.rigs.values():
            store.write_rig(rig, use_rig_id=True)
        for frame in posed.frames.values():
            store.write_frame(frame, use_frame_id=True)
        for image in posed.images.values():
            store.write_image(image, use_image_id=True)
    pycolmap.extract_features(database, images)
    print("matches", flush=True)
    pycolmap.match_exhaustive(database) if len(posed.images) < 200 else pycolmap.match_sequential(database)
    print("points", flush=True)
    out.mkdir()
    found = pycolmap.triangulate_points(posed, database, images, out)
    print(f"{found.num_points3D()} points of {len(posed.images)} images: {out}")
    if found.num_points3D() < 1000:
        print("that is few: the images show little that others show, too, or the poses are wrong")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]))
