"""Pictures of the withheld check: confusion matrix, reliability diagram, accuracy against severity."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np


def draw(result, out):
    """Write OUT_confusion.png, OUT_reliability.png and OUT_severity.png."""
    _confusion(result["confusion"], f"{out}_confusion.png")
    _reliability(result, f"{out}_reliability.png")
    _severity(result["per_severity"], f"{out}_severity.png")


def _confusion(confusion, path):
    names, counts = confusion["classes"], np.array(confusion["counts"], float)
    rows = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    figure, axes = plt.subplots(figsize=(10, 9), layout="constrained")
    image = axes.imshow(rows, cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(range(len(names)), names, rotation=90)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel("named first")
    axes.set_ylabel("true cause")
    for i, j in zip(*np.nonzero(counts), strict=True):
        axes.text(
            j,
            i,
            int(counts[i, j]),
            ha="center",
            va="center",
            fontsize=7,
            color="white" if rows[i, j] > 0.5 else "black",
        )
    figure.colorbar(image, label="share of the row", shrink=0.7)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _reliability(result, path):
    rows = result["reliability"]
    figure, axes = plt.subplots(figsize=(5, 5), layout="constrained")
    axes.plot([0, 1], [0, 1], color="grey", lw=1)
    if rows:
        stated, seen = [r["stated"] for r in rows], np.array([r["seen"] for r in rows])
        low, high = np.array([r["low"] for r in rows]), np.array([r["high"] for r in rows])
        axes.errorbar(
            stated, seen, yerr=[np.maximum(seen - low, 0), np.maximum(high - seen, 0)], fmt="o", capsize=3
        )
        for r in rows:
            axes.annotate(
                str(r["n"]), (r["stated"], r["seen"]), textcoords="offset points", xytext=(6, -10), fontsize=8
            )
    error = result["figures"]["calibration_error"]["value"]
    axes.set_title("" if error is None else f"expected calibration error {error:.3f}")
    axes.set_xlabel("stated probability of the most probable class")
    axes.set_ylabel("share in which it is the true one")
    axes.set_xlim(0, 1.02)
    axes.set_ylim(0, 1.02)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _severity(severities, path):
    shown = {k: v for k, v in severities.items() if v["n"]}
    figure, axes = plt.subplots(figsize=(5, 4), layout="constrained")
    for i, value in enumerate(shown.values()):
        low, high = max(value["value"] - value["low"], 0), max(value["high"] - value["value"], 0)
        axes.errorbar([i], [value["value"]], yerr=[[low], [high]], fmt="o", capsize=4, color="tab:blue")
    axes.set_xticks(range(len(shown)), [f"{k}\nn = {v['n']}" for k, v in shown.items()])
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("severity: effect over noise floor (low < 2, medium < 4.5)")
    axes.set_ylabel("cause named first")
    figure.savefig(path, dpi=110)
    plt.close(figure)
