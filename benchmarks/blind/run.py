"""Diagnoses every case of a set, from its model and records alone.

    .venv/bin/python benchmarks/blind/run.py OUT [--shard i/n] [--again]

OUT/found/NNNN.json gets what diagnosis.json holds and the seconds that it took, or how it failed. A second run goes on
where the first stopped; with --again cases that failed are tried once more.
"""

import argparse
import json
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import jax

sys.path.insert(0, str(Path(__file__).parent))
from generate import written

import jaxsid
from jaxsid.compilation import default_folder, keep_programs


def diagnosed(folder: Path) -> dict[str, Any]:
    """What is found in a case, or how it failed.

    Args:
        folder: model.toml, run1.csv and run2.csv.
    """
    began, processor = time.perf_counter(), time.process_time()
    took = lambda: {  # noqa: E731
        "seconds": round(time.perf_counter() - began, 2),
        "processor_seconds": round(time.process_time() - processor, 2),
    }
    try:
        model = jaxsid.read_model(folder / "model.toml")
        records = [jaxsid.read_record(folder / f"run{i}.csv", model) for i in (1, 2)]
        return {"diagnosis": jaxsid.diagnose(model, records).as_dict(), **took()}
    except Exception as error:
        return {"failure": repr(error), "traceback": traceback.format_exc(), **took()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--shard", default="0/1")
    parser.add_argument("--again", action="store_true")
    asked = parser.parse_args()
    part, parts = map(int, asked.shard.split("/"))
    for folder in sorted((asked.out / "cases").iterdir())[part::parts]:
        path = asked.out / "found" / f"{folder.name}.json"
        if path.exists() and not (asked.again and "failure" in json.loads(path.read_text())):
            continue
        found = diagnosed(folder)
        written(path, json.dumps(found, indent=1, default=float) + "\n")
        said = found.get("failure") or found["diagnosis"].get("verdict")
        print(f"{folder.name} {found['seconds']:7.1f} s  {said}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    keep_programs(default_folder())
    main()
