"""Scores tracks by motmetrics: reads lines `frame,kind,id,x,y` (kind 0 truth, 1 track) from stdin, prints IDF1 and MOTA."""

import sys
import warnings
from collections import defaultdict

warnings.filterwarnings("ignore")
import motmetrics
import numpy

frames = defaultdict(lambda: ([], []))
for line in sys.stdin:
    frame, kind, who, x, y = line.split(",")
    frames[int(frame)][int(kind)].append((int(who), float(x), float(y)))
accumulator = motmetrics.MOTAccumulator(auto_id=True)
for frame in sorted(frames):
    truth, found = frames[frame]
    places = [numpy.array([[x, y] for _, x, y in some]).reshape(-1, 2) for some in (truth, found)]
    apart = motmetrics.distances.norm2squared_matrix(*places, max_d2=0.25)
    accumulator.update([who for who, _, _ in truth], [who for who, _, _ in found], apart)
names = ["idf1", "mota", "num_switches", "num_misses", "num_false_positives", "num_objects"]
row = motmetrics.metrics.create().compute(accumulator, metrics=names).iloc[0]
print(*(float(row[name]) for name in names))
