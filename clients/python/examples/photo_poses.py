"""Finds the cameras of photographs, or of the frames of a video, with COLMAP on the CPU.

    pip install pycolmap
    ffmpeg -i walk.mp4 -vf fps=3 -q:v 2 photos/%04d.jpg     # of a video
    python photo_poses.py photos [OUT]

Writes models to OUT/sparse and says which is the largest, mostly 0 (without OUT: beside the folder of the photographs),
for `wildcity train OUT/sparse/0 --image-dir photos --out capture.ply`. The photographs are of one camera whose focal
length stays, in the order in which they were taken, and each shows much of what the one before it does.
"""

import sys
from pathlib import Path

import pycolmap


def main(photos: Path, out: Path) -> None:
    database = out / "colmap.db"
    if database.exists():
        raise SystemExit(f"{database} is there: remove it, or give another folder")
    out.mkdir(parents=True, exist_ok=True)
    # COLMAP writes a line for each image and each pair.
    pycolmap.logging.minloglevel = 1
    print("features", flush=True)
    pycolmap.extract_features(database, photos, camera_mode=pycolmap.CameraMode.SINGLE)
    print("matches", flush=True)
    pycolmap.match_sequential(database)
    print("cameras", flush=True)
    models = pycolmap.incremental_mapping(database, photos, out / "sparse")
    count = sum(1 for photo in photos.iterdir() if photo.is_file())
    if not models:
        raise SystemExit(f"no two of the {count} photographs fit together: take them closer to each other")
    index, model = max(models.items(), key=lambda item: item[1].num_reg_images())
    found = model.num_reg_images()
    print(f"{found} of {count} photographs, {model.num_points3D()} points: {out / 'sparse' / str(index)}")
    if found < count:
        print("the others do not fit: they show what moves, or too little of what their neighbours show")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    folder = Path(sys.argv[1])
    main(folder, Path(sys.argv[2]) if len(sys.argv) > 2 else folder.resolve().parent)
