"""calib.p9_20x88 and calib.p23_20x88: seconds of pf.calibrate without a guess, beside rivals on the same views."""

import json
import subprocess
from pathlib import Path

from calib_scene import SIZE, board, fastest, views
from peers import PEERS


def measure() -> list[dict]:
    """One figure a model and rival; the rivals fit one model, which is that of p9."""
    from pipefish.calibration import View, calibrate

    given = [View(board(), pixels) for pixels in views()]
    ours: dict[str, float] = {}
    rivals: dict[str, float] = {}
    script = Path(__file__).with_name("calib_peers.py")
    for _ in range(2):  # in turns
        for model in ("p9", "p23"):
            seconds = fastest(lambda model=model: calibrate(given, SIZE, model, "flat"), 10)
            ours[model] = min(seconds, ours.get(model, seconds))
        for python in PEERS.values():
            if not python.exists():
                continue
            done = subprocess.run([python, script], capture_output=True, text=True, check=False)
            for line in done.stdout.splitlines():
                figure = json.loads(line)
                rivals[figure["peer"]] = min(figure["seconds"], rivals.get(figure["peer"], figure["seconds"]))
    figures = []
    for model, seconds in ours.items():
        base = {"name": f"calib.{model}_20x88", "value": seconds, "unit": "s"}
        figures += [base | {"peer": peer, "peer_value": value} for peer, value in rivals.items()] or [base]
    return figures
