"""A made-up path loss: distance, and a smooth share of every parameter."""

import json
import math
import sys
from pathlib import Path

request = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
values = [entry["value"] for entry in request["parameters"]]
losses = []
for tx, rx in zip(request["links"]["tx"], request["links"]["rx"], strict=True):
    loss = 40 + 22 * math.log10(math.dist(tx, rx))
    for place, value in enumerate(values):
        loss += 6 * math.sin(value / 3 + rx[place] / 15)
    losses.append(loss)
Path(sys.argv[2]).write_text(json.dumps({"path_loss_db": losses}), encoding="utf-8")
