"""docs/reference/metrics.md: what a server says at `GET /metrics`, without values.

A second server has its twins in an object store, an empty one of this program, which adds the metrics of stores. A
metric with labels is listed once it has a value: so the first server is asked for a twin that does not exist, and for
a push that it refuses."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.request
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

HEAD = "<!-- Written by docs/generate.py from a running server. -->\n\n# Metrics\n\n"
HEAD += (
    "`GET /metrics` has these as OpenMetrics text. Names of counters get the suffix `_total`, of information `_info`. "
)
HEAD += "The metrics `wildcity_store_` exist with twins in an object store.\n\n"
LIMIT_S = 60.0
EMPTY = b"""<?xml version="1.0" encoding="UTF-8"?>
<ListBucketResult xmlns="http://s3.amazonaws.com/doc/2006-03-01/"><Name>bucket</Name><KeyCount>0</KeyCount><MaxKeys>1000</MaxKeys>
<IsTruncated>false</IsTruncated></ListBucketResult>"""


class Bucket(BaseHTTPRequestHandler):
    """A bucket without objects."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "application/xml")
        self.send_header("Content-Length", str(len(EMPTY)))
        self.end_headers()
        self.wfile.write(EMPTY)

    def log_message(self, *_: object) -> None:
        pass


def pages(root: Path, program: Path) -> tuple[dict[str, str], None]:
    found: dict[str, tuple[str, str]] = {}
    labels: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as home, HTTPServer(("127.0.0.1", 0), Bucket) as bucket:
        threading.Thread(target=bucket.serve_forever, daemon=True).start()
        for twins in ("twins", "s3://bucket/twins"):
            read(asked(program, Path(home), twins, f"http://127.0.0.1:{bucket.server_port}"), found, labels)
        bucket.shutdown()
    text = HEAD + "| metric | kind | label | |\n|---|---|---|---|\n"
    for name, (kind, what) in found.items():
        text += f"| `{name}` | {kind} | {labels.get(name, '')} | {what.rstrip('.')} |\n"
    return {"docs/reference/metrics.md": text}, None


def asked(program: Path, home: Path, twins: str, bucket: str) -> str:
    store = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_REGION": "c", "AWS_ALLOW_HTTP": "true"}
    environment = {"PATH": os.environ["PATH"], "HOME": str(home), "AWS_ENDPOINT": bucket, **store}
    command = [program, "serve", "--listen", "127.0.0.1:0", "--backend", "cpu", "--twins", twins]
    with subprocess.Popen(
        command, cwd=home, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            address = re.search(r"127\.0\.0\.1:\d+", line)
            if not address:
                raise SystemExit(f"{program} serve --twins {twins} said {line!r}")
            url = f"http://{address[0]}"
            if "://" not in twins:
                push(url)
            return request(f"{url}/metrics").decode()
        finally:
            server.terminate()


def push(url: str) -> None:
    """A push of a file that is no scene, and a request for it until it is refused."""
    scene = b"no scene"
    announced = {"name": "a.ply", "size": len(scene), "digest": f"sha-256:{hashlib.sha256(scene).hexdigest()}"}
    upload = json.loads(request(f"{url}/v1/uploads", json.dumps(announced).encode()))["id"]
    request(f"{url}/v1/uploads/{upload}", scene, "PATCH", {"Upload-Offset": "0"})
    body = json.dumps({"files": [{"upload": upload}]}).encode()
    state = json.loads(request(f"{url}/v1/twins/new/pushes", body))
    ends = time.monotonic() + LIMIT_S
    while state["state"] != "refused":
        if time.monotonic() > ends:
            raise SystemExit(f"a push of no scene is {state['state']}")
        time.sleep(0.05)
        state = json.loads(request(f"{url}/v1/twins/new/pushes/{state['id']}"))
    try:
        request(f"{url}/v1/twins/nowhere")
    except urllib.error.HTTPError as error:
        assert error.code == 404, error


def request(
    url: str, body: bytes | None = None, method: str | None = None, headers: dict[str, str] | None = None
) -> bytes:
    headers = {"Content-Type": "application/json", **(headers or {})}
    with urllib.request.urlopen(urllib.request.Request(url, body, headers, method=method), timeout=LIMIT_S) as answer:
        return bytes(answer.read())


def read(text: str, found: dict[str, tuple[str, str]], labels: dict[str, str]) -> None:
    helps = dict(re.findall(r"^# HELP (\S+) (.*)$", text, re.MULTILINE))
    for name, kind in re.findall(r"^# TYPE (\S+) (\S+)$", text, re.MULTILINE):
        found.setdefault(name, (kind, helps[name]))
        label = re.search(rf"^{name}(?:_total|_info)?{{([^}}]*)}}", text, re.MULTILINE)
        of = re.findall(r'(\w+)="', label[1]) if label else []
        if of and of != ["le"]:
            labels[name] = ", ".join(f"`{one}`" for one in of)
