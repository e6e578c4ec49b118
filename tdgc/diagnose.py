"""Diagnose why a deployed pair failed, from a log of its inputs and outputs.

    python -m tdgc.diagnose run.npz --export runs/export --outcome fell

Prints the diagnosis, writes it and the trace to the results folder, and reports whether the
decisions, clock, commands and joint targets in the log are those of the graphs. What only a
simulator knows is null in the trace, and the diagnosis lists what was unknown.
"""

import argparse
import sys
from pathlib import Path

from tdgc.benchmark import diagnosis, trace
from tdgc.deploy import log
from tdgc.deploy.controller import Controller
from tdgc.errors import require, script
from tdgc.files import make_folder
from tdgc.sim.geometry import read_geometry


@script("tdgc.diagnose")
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tdgc.diagnose", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("log", type=Path, help="the log, .npz or .csv (docs/deploy.md)")
    parser.add_argument("--export", type=Path, required=True, help="exported folder on the robot")
    parser.add_argument(
        "--outcome",
        choices=log.ENDS,
        help="how the episode ended; reached and timeout are seen in the log",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/diagnosis"), help="results folder (runs/diagnosis)"
    )
    args = parser.parse_args(arguments)
    require("a log's diagnosis", ("jsonschema", "onnxruntime"), "mujoco")
    require("a trace", ("pyarrow",), "trace")
    controller = Controller(args.export)
    geometry = read_geometry(controller.robot())
    found = log.read(args.log, controller)
    episode = log.trace(found, controller, args.outcome)
    compared = log.replay(found, controller)
    make_folder(args.out)
    (args.out / "diagnosis.csv").unlink(missing_ok=True)  # of an earlier run
    path = trace.write(episode, args.out)
    failure = None
    if episode.outcome != "reached":
        failure = diagnosis.diagnose(episode, float(geometry.hips[0, 0]))
        diagnosis.write([failure], args.out / "diagnosis.csv")
    print(f"{found.name}: {episode.outcome} after {episode['time'][-1]:.2f} s; trace in {path}")
    if failure is not None:
        print(f"{failure.layer}: {failure.cause}\n{failure.evidence}")
    differ = [
        f"{name} from {first:.2f} s on, by up to {largest:.3f}"
        for name, (largest, first) in compared.items()
        if first < float("inf")
    ]
    if differ:
        print(
            f"tdgc.diagnose: differs from the graphs: {'; '.join(differ)}: a value was not passed "
            "on or not logged as it was, or these are not the graphs that ran",
            file=sys.stderr,
        )
        return 1
    largest = max(off for off, _ in compared.values())
    print(f"{', '.join(compared)} match the graphs within {largest:.1e}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
