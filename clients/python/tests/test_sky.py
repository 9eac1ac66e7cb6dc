"""The sky of the demo twin, evaluated by numpy from its weights. The server's tests compare with these colours."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[3]


def test_the_expected_colours_of_the_server_follow_from_the_weights() -> None:
    spec = importlib.util.spec_from_file_location("sky", ROOT / "scenes" / "sky.py")
    assert spec is not None and spec.loader is not None
    sky = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sky)
    tensors = sky.read(ROOT / "scenes" / "sky.safetensors")
    rows = np.array(json.loads((ROOT / "tests" / "render" / "sky.json").read_text()))
    assert rows.shape[0] > 40
    away = rows[:, :3]
    assert np.abs(sky.colours(tensors, away) - rows[:, 3:6]).max() < 1e-12
    assert np.abs(sky.colours(tensors, away, 1) - rows[:, 6:9]).max() < 1e-12
    # A changed weight changes the colours.
    tensors["sky_head.layers.1.weight"] = tensors["sky_head.layers.1.weight"] * 1.001
    assert np.abs(sky.colours(tensors, away) - rows[:, 3:6]).max() > 1e-5
