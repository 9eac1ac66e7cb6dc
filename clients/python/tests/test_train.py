"""Stable-Baselines3 trains on `wildcity/Drive-v0` as it is. It needs PyTorch, so that the gate does not install it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from test_end_to_end import PAIR, Server, server

pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3, which needs PyTorch")
