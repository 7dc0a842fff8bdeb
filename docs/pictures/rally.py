"""Draws the strokes of a rally that `ballfg track` found, from the side and from above: docs/pictures/rally.png.

ballfg track ../shared/data/broadcast/rally.mp4 --out rally && python docs/pictures/rally.py rally
"""

import json
import re
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ballfg.estimation.rally.page import rally_page

COLOURS = {"+x": "#d55e00", "-x": "#0072b2"}
REGION = np.sqrt(4.605)  # radius of the 90 % region of two dimensions, standard deviations


def main() -> None:
    """Draws the folder that is named on the command line."""
    here = Path(__file__).parent
    page, _ = rally_page(Path(sys.argv[1]), None, here / "rally.html")
    (text,) = re.findall(r'id="data">(.*?)</script>', page, flags=re.DOTALL)
    data = json.loads(text)
    (low, high, near, far), height = data["table"]["extent"], data["table"]["height"]
    figure, (side, above) = plt.subplots(2, 1, figsize=(9.0, 6.9), height_ratios=(1.35, 3.1))
    side.plot((low, high), (height, height), color="#2f7d6b", lw=3)
    side.plot((0, 0), (height, height + data["table"]["net"]), color="#888888", lw=2)
    above.add_patch(plt.Rectangle((low, near), high - low, far - near, facecolor="#2f7d6b33", edgecolor="#2f7d6b"))
    above.plot((0, 0), (near - 0.15, far + 0.15), color="#888888", lw=2)
    for stroke in data["strokes"]:
        path, colour = np.array(stroke["path"]), COLOURS[stroke["end"]]
        side.plot(path[:, 1], path[:, 3], color=colour, lw=1.3)
        above.plot(path[:, 1], path[:, 2], color=colour, lw=0.9, alpha=0.6)
    for event in (one for one in data["events"] if one["kind"] == "bounce"):
        colour = next(COLOURS[one["end"]] for one in data["strokes"] if one["stroke"] == event["trajectory"])
        size = 2.0 * REGION * event["sigma_x"], 2.0 * REGION * event["sigma_y"]
        above.add_patch(matplotlib.patches.Ellipse((event["x"], event["y"]), *size, color=colour, alpha=0.4))
        above.annotate(event["trajectory"], (event["x"], event["y"]), (4, 4), textcoords="offset points", fontsize=8)
    side.set_ylabel("height over table, m")
    side.set_ylim(height - 0.1, height + 1.25)
    above.set(xlabel="x along the table, m", ylabel="y across it, m", ylim=(-1.9, 1.2))
    side.set_title("hit from +x orange, from −x blue; bounces with their 90 % regions", fontsize=10)
    for axes in (side, above):
        axes.set(xlim=(-3.3, 3.3), aspect="equal")
        axes.grid(alpha=0.25)
    figure.tight_layout()
    figure.savefig(here / "rally.png", dpi=110)


if __name__ == "__main__":
    main()
