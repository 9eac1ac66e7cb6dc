"""Writes the images of a twin's start, as the Python client decodes them: decode.py URL TWIN SIZES OUT.

SIZES is JSON: {CAMERA: [width, height]}. OUT gets one file of raw pixels for each camera."""

import json
import sys
from pathlib import Path

import wildcity
from wildcity import ImagePart, Outputs

url, twin, sizes, out = sys.argv[1:]
images = {name: ImagePart(size=tuple(size)) for name, size in json.loads(sizes).items()}
outputs = Outputs(quality=85, images=images)
with wildcity.connect(url) as client, client.open(twin, outputs=outputs, dynamics="dynamic") as session:
    for name, image in session.reset().images.items():
        Path(out, name).write_bytes(image.tobytes())
