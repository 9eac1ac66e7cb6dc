"""Drives straight ahead through a twin by teleport, and saves the images of all cameras.

python drive.py 127.0.0.1:8080 TWIN [OUT]
"""

import sys
from pathlib import Path

import wildcity
from PIL import Image
from wildcity import Outputs, Pose


def main(url: str, twin: str, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    with wildcity.connect(url) as client, client.open(twin, outputs=Outputs(depth=True)) as session:
        start = session.opened.start
        session.reset(seed=1)
        for step in range(1, 21):
            ahead = 0.5 * step  # metres: 5 m/s at 10 Hz
            observation = session.step(start @ Pose.flat(ahead, 0.0))
            camera, image = next(iter(observation.images.items()))
            farthest_m = observation.depth[camera].max()
            print(f"{observation}: {camera} {image.shape}, farthest {farthest_m:.1f} m")
            if step % 10 == 0:
                for camera, image in observation.images.items():
                    Image.fromarray(image).save(out / f"{step:03}_{camera}.png")
        print(session.close())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3] if len(sys.argv) > 3 else "drive"))
