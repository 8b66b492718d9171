"""cv2.stereo.QuasiDenseStereo (opencv-contrib) on the pairs of a folder, one thread; run by room_match.py.

match_peers.py FOLDER: for each NAME.npz (one, two: grey pictures) writes NAME.peer.npz (seconds, xy1, xy2). Seconds are
processor time of process(); its defaults; taking the matches out into Python is not counted.
"""

import sys
import time
from pathlib import Path

import cv2
import numpy as np

cv2.setNumThreads(1)
for path in sorted(Path(sys.argv[1]).glob("*.npz")):
    given = np.load(path)
    one, two = given["one"], given["two"]
    stereo = cv2.stereo.QuasiDenseStereo_create((one.shape[1], one.shape[0]))
    start = time.process_time()
    stereo.process(one, two)
    seconds = time.process_time() - start
    found = stereo.getDenseMatches()
    xy1 = np.array([m.p0 for m in found], np.float64).reshape(-1, 2)
    xy2 = np.array([m.p1 for m in found], np.float64).reshape(-1, 2)
    np.savez(path.with_suffix(".peer.npz"), seconds=seconds, xy1=xy1, xy2=xy2)
