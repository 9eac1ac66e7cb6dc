import assert from "node:assert/strict";
import { test } from "node:test";
import { bundled } from "./bundle.mjs";

const { heading, looking, multiply, rotate, transform } = await bundled("pose");
const near = (found, expected) => {
  for (const [at, value] of found.entries()) assert.ok(Math.abs(value - expected[at]) < 1e-12, `${found}`);
};

test("rotations are those of the protocol", () => {
  const half = Math.SQRT1_2;
  near(rotate([half, 0, 0, half], [1, 0, 0]), [0, 1, 0]);
  // A camera that looks straight ahead: its z is the rig's x.
  near(rotate([0.5, -0.5, 0.5, -0.5], [0, 0, 1]), [1, 0, 0]);
  near(transform({ xyz: [1, 2, 3], q: [half, 0, 0, half] }, [1, 0, 0]), [1, 3, 3]);
  near(multiply([half, 0, 0, half], [half, 0, 0, half]), [0, 0, 0, 1]);
});

test("a free camera looks along its heading and up by its pitch", () => {
  near(rotate(looking(0.3, 0), [1, 0, 0]), [Math.cos(0.3), Math.sin(0.3), 0]);
  const [, , up] = rotate(looking(2, 0.5), [1, 0, 0]);
  assert.ok(Math.abs(up - Math.sin(0.5)) < 1e-12);
  assert.ok(Math.abs(heading(looking(-1.2, 0.7)) + 1.2) < 1e-12);
});
