"""How much a watcher slows the steps of a session: watch_cost.py URL TWIN [BLOCKS].

Blocks of steps with a watcher and without one take turns, so that other load of the machine falls on both. Prints the
median step time of each, and their ratio with a 95 % interval from 2,000 resamples of the pairs of blocks."""

import json
import random
import statistics
import sys
import threading
import time

import wildcity
from websockets.sync.client import connect
from wildcity import ImagePart, Outputs

STEPS = 8

url, twin = sys.argv[1:3]
blocks = int(sys.argv[3]) if len(sys.argv) > 3 else 40
sizes = {
    "front": (480, 310),
    "front_left": (240, 155),
    "front_right": (240, 155),
    "left": (248, 146),
    "right": (248, 146),
    "rear": (248, 146),
}
outputs = Outputs(quality=85, images={name: ImagePart(size=size) for name, size in sizes.items()})


def watch(session, stop, seen):
    """Reads what a watcher gets, until it is to stop."""
    with connect(
        url.replace("/v1/session", f"/v1/sessions/{session}/watch"),
        subprotocols=["wildcity.watch.v1"],
        max_size=None,
        proxy=None,
    ) as watcher:
        while not stop.is_set():
            try:
                watcher.recv(timeout=0.05)
                seen.append(time.monotonic())
            except TimeoutError:
                pass


def block(session, at, is_watched):
    """The times of some steps, in milliseconds. The first one is not counted: the watcher connects during it."""
    stop, seen = threading.Event(), []
    thread = threading.Thread(target=watch, args=("watched", stop, seen))
    if is_watched:
        thread.start()
        time.sleep(0.1)
    times = []
    for step in range(STEPS + 1):
        pose = wildcity.Pose((at + 0.2 * (step % 2), -1.75, 0.0), (1, 0, 0, 0))
        begun = time.perf_counter()
        session.step(pose)
        times.append(1e3 * (time.perf_counter() - begun))
    if is_watched:
        stop.set()
        thread.join()
        assert seen, "the watcher saw nothing"
    return statistics.median(times[1:])


with wildcity.connect(url) as client, client.open(twin, session="watched", outputs=outputs) as session:
    session.reset()
    pairs = []
    for number in range(blocks):
        order = [True, False] if number % 2 else [False, True]
        times = {is_watched: block(session, 20.0, is_watched) for is_watched in order}
        pairs.append((times[True], times[False]))

ratio = lambda some: statistics.median(a / b for a, b in some)
draw = random.Random(1)
resampled = sorted(ratio(draw.choices(pairs, k=len(pairs))) for _ in range(2_000))
print(
    json.dumps(
        {
            "watched_ms": round(statistics.median(a for a, _ in pairs), 2),
            "alone_ms": round(statistics.median(b for _, b in pairs), 2),
            "ratio": round(ratio(pairs), 4),
            "interval_95": [round(resampled[50], 4), round(resampled[1949], 4)],
            "blocks": blocks,
            "steps": STEPS,
        }
    )
)
