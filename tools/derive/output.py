"""Writing results so that a run that is killed leaves none half-written."""

import gzip
import json


def write_json(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    tmp = path.with_name(path.name + ".part")
    text = json.dumps(value, separators=(",", ":"), default=str)
    if path.name.endswith(".gz"):
        with gzip.GzipFile(tmp, "wb", compresslevel=4, mtime=0) as f:
            f.write(text.encode())
    else:
        tmp.write_text(text + "\n")
    tmp.replace(path)


def failed(root, name, reason, stage="sample"):
    with open(root / "failed.jsonl", "a") as f:
        f.write(json.dumps({"class": name, "stage": stage, "reason": reason[:500]}) + "\n")
