"""Builds the package as setuptools does, and no sdist.

An sdist of the name `wildcity` would install the client without the program, on any platform that has no wheel.
"""

from __future__ import annotations

from typing import Any

from setuptools import build_meta
from setuptools.build_meta import (  # noqa: F401
    build_editable,
    build_wheel,
    get_requires_for_build_editable,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

get_requires_for_build_sdist = build_meta.get_requires_for_build_sdist


def build_sdist(*_: Any) -> str:
    """Refuses."""
    raise SystemExit(
        "wildcity has no sdist, which would lack the program: build a wheel with clients/python/build_wheel.py"
    )
