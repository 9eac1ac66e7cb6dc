"""Plants one fault into each formula of the gradients of cpu and reference, and says which test notices it.

    python3 tests/render/plant.py [FILE ..]        (cargo by $CARGO; about a minute for each fault)

The sources are changed in place, one fault at a time, and restored; commit first. The exit code is 1 if a fault is not
noticed. (Those of the shaders are planted by the test `gpu`.)
"""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RENDER = ROOT / "src" / "render"

# (file of src/render, old, new)
FAULTS = [
    ("cpu/blend_gradient.rs", "(-weight).mul_add(energy, load(&self.behind[block]))", "load(&self.behind[block])"),
    ("cpu/blend_gradient.rs", "energy - behind / after", "energy - behind"),
    (
        "cpu/blend_gradient.rs",
        "(counts & raw.simd_le(cap)).select(weight * by_weight, zero)",
        "counts.select(weight * by_weight, zero)",
    ),
    ("cpu/blend_gradient.rs", "gu.mul_add(v, sums[partial::UV])", "gu.mul_add(u, sums[partial::UV])"),
    ("cpu/blend_gradient.rs", "-(load(&sums.transmittance[block]) * by_opacity)", "-by_opacity"),
    (
        "cpu/project/gradient/pinhole.rs",
        "total.mul_add(-per_ln2, by.load(simd, partial::VV))",
        "by.load(simd, partial::VV)",
    ),
    ("cpu/project/gradient/pinhole.rs", "is_free.select(inverse_z * q.dot(forward), splat(0.0))", "splat(0.0)"),
    ("cpu/project/gradient/pinhole.rs", "- along * inverse_z", ""),
    ("cpu/project/gradient/pinhole.rs", "q_x.cross(jw_x).plus(q_y.cross(jw_y))", "q_x.cross(jw_x)"),
    ("cpu/project/gradient/pinhole.rs", "(shrink - before) / det_native", "shrink / det_native"),
    ("cpu/project/gradient/color.rs", "rgb.x.simd_gt(zero).select(tinted.x, zero)", "tinted.x"),
    ("cpu/project/gradient/color.rs", "unit.mul_add(-unit.dot(by_direction), by_direction)", "by_direction"),
    (
        "cpu/project/gradient/color.rs",
        "[-(twice(s) * xy), by_y, splat(8.0 * k2) * yz]",
        "[twice(s) * xy, by_y, splat(8.0 * k2) * yz]",
    ),
    ("cpu/project/gradient/color.rs", "[d * z, zero, d * x]", "[d * x, zero, d * z]"),
    (
        "cpu/project/gradient/lens.rs",
        "view.origin_m() + mean_m(block.columns, lane)",
        "view.origin_m() + 1.001 * mean_m(block.columns, lane)",
    ),
    ("cpu/project/gradient/mod.rs", "[-twice.dot(v), x, y, z]", "[twice.dot(v), x, y, z]"),
    (
        "cpu/bin/gather.rs",
        "*first += segment.macro_tile(number).len();",
        "*first += segment.macro_tile(number).len() / 2;",
    ),
    ("gradient/shape.rs", "by_covariance += by_native / det_native", "by_covariance += 0.0 * by_native / det_native"),
    (
        "gradient/shape.rs",
        "by_px += moment_per_px * (motion_px.dot(by_px) * gain);",
        "by_px += 0.5 * moment_per_px * (motion_px.dot(by_px) * gain);",
    ),
    ("gradient/shape.rs", "let by_moment = -self.toward.dot(velocity(view).0);", "let by_moment = 0.0;"),
    ("gradient/shape.rs", "by_point.z -= by_rows[axis].dot(rows[axis]) / point_m.z;", ""),
    ("gradient/sums.rs", "uv * l1 + vv * l2", "vv * l2"),
    ("gradient/color.rs", "- direction.dot(by_direction) * direction", ""),
    ("gradient/twist.rs", "self.phi + self.rho.cross(position_m)", "self.phi + 0.5 * self.rho.cross(position_m)"),
    ("reference/gradient.rs", "behind -= transmittance * by.opacity[pixel];", ""),
    ("reference/gradient.rs", "if contribution.is_capped {", "if false {"),
    ("reference/gradient.rs", "- by_ln_shrink * splat.conic", ""),
]


def run() -> tuple[int, list[str]]:
    command = [os.environ.get("CARGO", "cargo"), "test", "--locked", "--workspace", "--features", "full,otlp"]
    done = subprocess.run(
        [*command, "--test", "render", "--test", "train", "--no-fail-fast", "--", "gradient", "check", "twist"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    said = done.stdout + done.stderr
    return done.returncode, re.findall(r"^test (\S+) \.\.\. FAILED", said, re.MULTILINE) or re.findall(
        r"^error.*", said, re.MULTILINE
    )


def main() -> int:
    chosen = [fault for fault in FAULTS if not sys.argv[1:] or fault[0] in sys.argv[1:]]
    missed = 0
    for file, old, new in chosen:
        path = RENDER / file
        sound = path.read_text()
        assert old in sound, f"{file} has no {old!r}: the list of faults is out of date"
        try:
            path.write_text(sound.replace(old, new, 1))
            status, failed = run()
        finally:
            path.write_text(sound)
        is_built = not any(line.startswith("error[") or "could not compile" in line for line in failed)
        missed += status == 0 or not is_built
        verdict = (
            "NOT NOTICED" if status == 0 else ", ".join(failed[:2]) if is_built else f"DOES NOT BUILD: {failed[:1]}"
        )
        print(f"{verdict} | {file}: {' '.join(old.split())[:70]}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} faults are noticed")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
