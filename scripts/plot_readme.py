#!/usr/bin/env python3
"""Draws the README's picture from a result of ksim (standard library only).

  ksim score … --format json | python3 scripts/plot_readme.py docs/k-sim.svg
  ksim demo --format json    | python3 scripts/plot_readme.py docs/demo.svg

Left: every episode's mean score, the mean of these means and its 95 % interval. Right: how far the
steps lie from the data, as the quantiles 5, 25, 50, 75 and 95 % of distance / √dim, where dim is
the width of state and action together; a step left of γ scores 1.
"""
import json
import math
import pathlib
import sys
from html import escape

WIDTH, ROW, TOP, BOTTOM = 820, 46, 46, 44
LEFT_PANEL, RIGHT_PANEL = (150, 430), (530, 800)
INK, SOFT, GRID, ACCENT, FILL = "#24292f", "#6e7781", "#d0d7de", "#0969da", "#b6d4f5"


def line(x1, y1, x2, y2, color, width=1.0, extra=""):
    return (f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" '
            f'stroke="{color}" stroke-width="{width}" {extra}/>')


def text(x, y, words, anchor="middle", color=INK, size=13):
    return (f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{color}" '
            f'font-size="{size}">{escape(words)}</text>')


class Axis:
    """A horizontal axis from 0 to `end`, drawn between two pixels."""

    def __init__(self, panel, end, step):
        (self.start, self.stop), self.end, self.step = panel, end, step

    def at(self, value):
        return self.start + (self.stop - self.start) * min(value, self.end) / self.end

    def draw(self, bottom, title):
        for tick in range(round(self.end / self.step) + 1):
            value = tick * self.step
            yield line(self.at(value), TOP - 12, self.at(value), bottom, GRID)
            yield text(self.at(value), bottom + 16, f"{value:g}", color=SOFT, size=11)
        yield text((self.start + self.stop) / 2, 20, title, color=SOFT)


def scores(axis, y, result):
    """Dots for the episodes, a mark and a bar for their mean and its interval, and K-Sim."""
    for episode in result["episodes"]:
        yield (f'<circle cx="{axis.at(episode["k_sim"]):.1f}" cy="{y:.1f}" r="3.2" '
               f'fill="{SOFT}" fill-opacity="0.35"/>')
    if result["interval_95"]:
        low, high = map(axis.at, result["interval_95"])
        yield line(low, y, high, y, ACCENT, 4, 'stroke-linecap="round" stroke-opacity="0.55"')
    mean = axis.at(result["k_sim_episode_mean"])
    yield f'<circle cx="{mean:.1f}" cy="{y:.1f}" r="5.5" fill="{ACCENT}"/>'
    yield text(axis.stop + 44, y + 5, f'{result["k_sim"]:.3f}', color=ACCENT, size=15)


def distances(axis, y, result):
    """Whiskers from 5 to 95 %, a box from 25 to 75 %, a stroke at the median."""
    q05, q25, q50, q75, q95 = map(axis.at, result["scaled_distance_quantiles"].values())
    yield line(q05, y, q95, y, ACCENT, 1.5)
    yield (f'<rect x="{q25:.1f}" y="{y - 9:.1f}" width="{q75 - q25:.1f}" height="18" '
           f'fill="{FILL}" stroke="{ACCENT}"/>')
    yield line(q50, y - 9, q50, y + 9, ACCENT, 2.5)


def draw(document):
    results, gamma = document["results"], document["parameters"]["gamma"]
    bottom = TOP + ROW * len(results)
    farthest = max(r["scaled_distance_quantiles"]["q95"] for r in results)
    left = Axis(LEFT_PANEL, 1.0, 0.25)
    right = Axis(RIGHT_PANEL, math.ceil(max(farthest, gamma) * 2) / 2, 0.5)
    yield (f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{bottom + BOTTOM}" '
           f'viewBox="0 0 {WIDTH} {bottom + BOTTOM}" font-family="sans-serif">')
    yield '<rect width="100%" height="100%" fill="#ffffff"/>'
    yield from left.draw(bottom, "score: episodes, their mean, 95 % interval")
    yield text(left.stop + 44, 20, "K-Sim", color=ACCENT)
    yield from right.draw(bottom, "distance from the data / √dim")
    yield line(right.at(gamma), TOP - 12, right.at(gamma), bottom, INK, 1, 'stroke-dasharray="4 3"')
    yield text(right.at(gamma), bottom + 34, f"γ = {gamma:g}: score 1 to the left", size=11)
    for row, result in enumerate(results):
        y = TOP + ROW * (row + 0.5)
        name = result["planner"] or pathlib.Path(result["file"]).stem
        yield text(left.start - 14, y + 5, name.split("_")[-1], "end")
        yield from scores(left, y, result)
        yield from distances(right, y, result)
    yield "</svg>\n"


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    pathlib.Path(sys.argv[1]).write_text("\n".join(draw(json.load(sys.stdin))), encoding="utf-8")


main()
