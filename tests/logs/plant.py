"""Plants one fault at a time into the converters of logs (clients/python/src/wildcity/logs), and runs their tests.

    WILDCITY_BIN=target/debug/wildcity python3 tests/logs/plant.py [FILE ..]     (with the packages of the extra `test`)

The exit code is 1 if no test notices a fault, or if a fault is not where it should be planted.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

CLIENT = Path(__file__).resolve().parents[2] / "clients" / "python"

# (file of wildcity/logs, its tests, old, new)
FAULTS = [
    ("lenses.py", "nuscenes", "shift = 0.5 if", "shift = 0.0 if"),
    ("lenses.py", "bags", "[c[0], c[1], *c[4:8]]", "[c[0], c[1], *c[5:8], c[4]]"),
    ("lenses.py", "parts", "slope = 1 + t2 * (3 * k[0]", "slope = 1 + t2 * (1 * k[0]"),
    ("lenses.py", "nuscenes", "if distance > 30:", "if distance > 3000:"),
    ("frames.py", "bags", "part = float(time_us", "part = 0 * float(time_us"),
    ("frames.py", "parts", "q[1 + j], q[1 + k] = m[j, i] + m[i, j]", "q[1 + j], q[1 + k] = m[j, i] - m[i, j]"),
    ("frames.py", "parts", "a, cosine = -a, -cosine", "a, cosine = a, -cosine"),
    ("tables.py", "parts", "heapq.merge(*runs)", "(line for run in runs for line in run)"),
    ("tables.py", "parts", "clash = clash or (last[sensor], text)", "pass"),
    ("tables.py", "parts", "if interval > GAP_FACTOR", "if interval > 3 * GAP_FACTOR"),
    ("tableio.py", "parts", "text[at:] + more, 0", "text[at + 1 :] + more, 0"),
    ("points.py", "parts", "argsort(self.time_us[order]", "argsort(-self.time_us[order]"),
    ("earth.py", "comma2k19", "for _ in range(12)", "for _ in range(1)"),
    ("earth.py", "lanelet2", "(2 - FLATTENING)", "(1 - FLATTENING)"),
    ("maps.py", "argoverse2", "_spread(right, count)", "_spread(right[::-1], count)"),
    ("writer.py", "nuscenes", "moved[:3, 3] -= self.origin_m", "pass"),
    ("writer.py", "nuscenes", 'if len(whole) < len(lines):', "if False:"),
    ("writer.py", "nuscenes", "os.rename(self.part, self.out)", "shutil.copytree(self.part, self.out)"),
    ("writer.py", "nuscenes", "if same.exists() and same.read_text", "if False and same.read_text"),
    ("writer.py", "parts", "if clash:", "if False:"),
    ("nuscenes.py", "nuscenes", "(length, width, height), pose", "(width, length, height), pose"),
    ("nuscenes.py", "nuscenes", "compensated_to_us=time_us", "compensated_to_us=time_us + 1"),
    ("nuscenes.py", "nuscenes", "after <= times[row", "after < times[row[\"token\"]] - 10**9 + 0 * times[row"),
    ("bags.py", "bags", "in_rig = [turn @ (", "in_rig = [np.array("),
    ("bags.py", "bags", "world_from_child @ inverse(self.rig_from_child)", "world_from_child @ self.rig_from_child"),
    ("bags.py", "bags", "if stamp_ns // 1000 <= before // 1000:", "if False:"),
    ("bag_content.py", "bags", "times = stamp_ns + np.rint", "times = stamp_ns - np.rint"),
    ("bag_content.py", "bags", "[2, 1, 0, 3]", "[0, 1, 2, 3]"),
    ("bag_content.py", "bags", "[:, :row]", "[:, -row:]"),
    ("bag_frames.py", "bags", "step is None else step @ pose", "step is None else pose @ step"),
    ("bag_reader.py", "bags", 'unpack_from("<III", self.data)', 'unpack_from("<III", self.data, 4)'),
    ("kitti.py", "kitti", "camera_from_0[:3, 3] = np.linalg.solve(p[:, :3], p[:, 3])", "pass"),
    ("kitti.py", "kitti", "part = (azimuth + math.pi)", "part = (math.pi - azimuth)"),
    ("kitti.py", "kitti", "z + height / 2", "z"),
    ("kitti.py", "kitti", "about_z @ about_y @ about_x", "about_x @ about_y @ about_z"),
    ("kitti.py", "kitti", "packet[17:20], packet[11:14]", "packet[11:14], packet[17:20]"),
    ("kitti360.py", "kitti", "mount @ inverse(turn)", "mount @ turn"),
    ("kitti360.py", "kitti", "pose[:3, :3] = u @ v", "pose[:3, :3] = v"),
    ("argoverse2.py", "argoverse2", "poses.at(time_us) @ _pose(row", "_pose(row"),
    ("argoverse2.py", "argoverse2", 'int(path.stem) + found["offset_ns"]', 'int(path.stem) - found["offset_ns"]'),
    ("argoverse2.py", "argoverse2", 'size = (int(row["width_px"])', 'size = (int(row["height_px"])'),
    ("argoverse2.py", "argoverse2", '"PIT": (17, 583710', '"PIT": (17, 583711'),
    ("nuplan.py", "nuplan", "np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)", "np.cos(yaw), 0, 0, np.sin(yaw)"),
    ("nuplan.py", "nuplan", "lens=lens", "lens=None"),
    ("nuplan.py", "nuplan", "raise pickle.UnpicklingError(", "return super().find_class(module, name) or ("),
    ("waymo.py", "waymo", "from_middle=False", "from_middle=True"),
    ("waymo.py", "waymo", "done - shutter / 2", "done"),
    ("waymo.py", "waymo", "@ CAMERA_AXES", "@ np.eye(4)"),
    ("waymo_range.py", "waymo", "* np.pi - heading", "* np.pi + heading"),
    ("waymo_range.py", "waymo", "width - columns - 0.5", "width - columns"),
    ("waymo_range.py", "waymo", "[::-1][rows]", "[rows]"),
    ("pose_files.py", "poses", "[words[7], *words[4:7]]", "words[4:8]"),
    ("pose_files.py", "poses", "int(Decimal(text) * 1_000_000)", "int(float(text) * 1e6)"),
    ("calibrations.py", "poses", "imu_from_camera @ inverse(", "imu_from_camera @ ("),
    ("poses.py", "poses", "CAMERA_AXES @ pose @ inverse(CAMERA_AXES)", "pose @ inverse(CAMERA_AXES)"),
    ("euroc.py", "poses", "mount[:3, :3] @ values[:3], mount", "values[:3], mount"),
    ("pai.py", "pai", "poses.at(reference_us) @ box", 'poses.at(int(row["timestamp_us"])) @ box'),
    ("pai.py", "pai", "return offline if offline.exists()", "return offline if not offline.exists()"),
    ("pai.py", "pai", "writer.lidar(lidar, self.mounts[lidar])", "writer.lidar(lidar, np.eye(4))"),
    ("pai_lenses.py", "pai", '"cx": center[0] + 0.5', '"cx": center[0]'),
    ("pai_lenses.py", "pai", "[*k[:2], *p, *k[2:], *s]", "[*k[:4], *p, *k[4:], *s]"),
    ("videos.py", "pai", "if count != len(times):", "if False:"),
    ("nurec.py", "nurec", "inverse(numbers(world_to_nre", "(numbers(world_to_nre"),
    ("nurec.py", "nurec", "(qw, qx, qy, qz)", "(qx, qy, qz, qw)"),
    ("comma2k19.py", "comma2k19", "axes @ rotation(q) @ _DOWN_TO_UP", "axes @ rotation(q).T @ _DOWN_TO_UP"),
    ("comma2k19.py", "comma2k19", "from_middle=False", "from_middle=True"),
    ("pandaset.py", "pandaset", "float(one[\"yaw\"]) + math.pi / 2", "float(one[\"yaw\"])"),
    ("pandaset.py", "pandaset", "(sides[1], sides[0], sides[2])", "(sides[0], sides[1], sides[2])"),
    ("pandaset.py", "pandaset", "(math.sqrt(0.5), 0, 0, math.sqrt(0.5))", "(math.sqrt(0.5), 0, 0, -math.sqrt(0.5))"),
    ("pandaset.py", "pandaset", 'for axis in "wxyz"]', 'for axis in "xyzw"]'),
    ("pandaset.py", "pandaset", "@ world_from_rig[:3, :3]", "@ world_from_rig[:3, :3].T"),
    ("pandaset.py", "pandaset", "inverse(poses.at(time_us)) @", "inverse(poses.at(int(poses.times_us[0]))) @"),
    ("pandaset.py", "pandaset", "if max(moves) > MAX_MOVE_M", "if False"),
    ("frame_pickles.py", "pandaset", 'raise pickle.UnpicklingError(f"a', "return super().find_class(module, name) #"),
    ("mei.py", "kitti", "lens.k[0] + m2 * lens.k[1]", "lens.k[1] + m2 * lens.k[0]"),
    ("mei.py", "kitti", "if not error_px <= MAX_ERROR_PX", "if False"),
    ("kitti360.py", "kitti", "mount, str(path), lens=fit", "mount, str(path), from_middle=False, lens=fit"),
    ("pcd.py", "nuplan", "if len(data) != points * row.itemsize:", "if False:"),
    ("nuplan.py", "nuplan", "writer.lidar(name, _pose(values[0]", "writer.lidar(name, _pose([0, 0, 0]"),
    ("ncore.py", "ncore", "about_z @ about_y @ about_x", "about_x @ about_y @ about_z"),
    ("ncore.py", "ncore", "target_from_its @ its_from_frame", "its_from_frame @ target_from_its"),
    ("ncore.py", "ncore", "direction[ray] * distance[which, ray]", "direction[ray] * distance[0, ray]"),
    ("ncore.py", "ncore", "ast.literal_eval(key)", "eval(key)"),
    ("ncore_store.py", "ncore", 'compressor.get("id") not in _CODECS', "False"),
    ("ncore_store.py", "ncore", "number * chunk for number", "0 * chunk for number"),
    ("inria.py", "inria", "round(index * 1e6 / options.rate)", "round(index * 1e6 * options.rate)"),
    ("inria.py", "inria", "@ inverse(CAMERA_AXES)", "@ CAMERA_AXES"),
    ("inria.py", "inria", "from_middle=False", "from_middle=True"),
    ("zod.py", "zod", 'core_us + found["timestamp"]', 'core_us - found["timestamp"]'),
    ("zod.py", "zod", "compensated_us = core_us if", "compensated_us = None if"),
    ("zod.py", "zod", "fisheye(list(distortion)", "fisheye(list(distortion)[::-1]"),
    ("zod.py", "zod", "poses.at(time_us) @ rig_from_lidar @", "poses.at(time_us) @"),
    ("lanelet2.py", "lanelet2", "ends.get((left[-1], right[-1]), [])", "ends.get((left[0], right[0]), [])"),
    ("lanelet2.py", "lanelet2", "across[1] - ahead[1] * across[0] > 0", "across[1] - ahead[1] * across[0] < 0"),
    ("lanelet2.py", "lanelet2", "right, b = right[::-1], b[::-1]", "pass"),
]  # fmt: skip


def main(chosen: list[str]) -> int:
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "src"
        shutil.copytree(CLIENT / "src", copy, ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
        for file, tests, old, new in FAULTS:
            if chosen and file not in chosen:
                continue
            path = copy / "wildcity" / "logs" / file
            whole = path.read_text()
            if old not in whole:
                print(f"NOT THERE  {file}: {old}", flush=True)
                missed += 1
                continue
            path.write_text(whole.replace(old, new, 1))
            command = [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                "-x",
                "-p",
                "no:cacheprovider",
                f"tests/test_logs_{tests}.py",
            ]
            environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
            done = subprocess.run(command, cwd=CLIENT, env=environment, capture_output=True, text=True)
            path.write_text(whole)
            is_noticed = done.returncode == 1
            missed += not is_noticed
            print(f"{'noticed' if is_noticed else 'MISSED '}  {file}: {old} -> {new}", flush=True)
    print(f"{missed} faults were not noticed")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
