"""Holds what was found against what is true.

    .venv/bin/python benchmarks/blind/score.py OUT

OUT/score.json gets all shares with their Wilson intervals of 95 %, recall by kind, confusions and what calibration
plots need; the table is printed. Baselines are taken from OUT/baselines where they exist. The oracle of the closure
is the true system itself: it leaves the noise and closes 1, so that the fraction stands as it is reported.
"""

import json
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from deviations import pulls, within
from equivalent import answer, as_good, right_answers, same_place
from generate import written

LEAST = 0.3  # gap in noise from which on a case counts
BINS = 10


class Scored(NamedTuple):
    """A case next to its truth."""

    label: dict[str, Any]
    found: dict[str, Any]  # diagnosis, empty after a failure
    seconds: float

    @property
    def truth(self) -> str:
        """none, effect or unknown."""
        return self.label["truth"]

    @property
    def verdict(self) -> str:
        """What was said."""
        return self.found.get("verdict", "failure")

    @property
    def counts(self) -> bool:
        """Whether the effects are large enough to be asked for."""
        return all(e.get("gap", e["gap_alone"]) >= LEAST for e in self.label["effects"])

    @property
    def ranked(self) -> list[dict[str, Any]]:
        """Effects, most probable first; those selected where there is no ranking."""
        return self.found.get("effects") or self.found.get("selected") or []


def cases(out: Path) -> list[Scored]:
    """All that have been diagnosed.

    Args:
        out: folder of the set.
    """
    rows = []
    for path in sorted((out / "found").glob("*.json")):
        found = json.loads(path.read_text())
        label = json.loads((out / "labels" / path.name).read_text())
        rows.append(Scored(label, found.get("diagnosis", {}), found["seconds"]))
    return rows


def among(case: Scored, number: int, first: int) -> bool:
    """Whether an effect is among the first ones found.

    Args:
        case: one.
        number: of the true effect.
        first: how many are looked at.
    """
    right = right_answers(case.label, number)
    return any(answer(e["kind"], e["place"]) in right for e in case.ranked[:first])


def both(case: Scored) -> bool:
    """Whether the two true effects are among those selected."""
    said = {answer(e["kind"], e["place"]) for e in case.found.get("selected") or []}
    hits = [said & right_answers(case.label, i) for i in range(2)]
    return all(hits) and len(set.union(*hits)) >= 2


def both_alone(case: Scored) -> bool:
    """Whether the selected effects are the two true ones and no other."""
    return both(case) and len(case.found.get("selected") or []) == 2


def first_is_right(case: Scored) -> bool:
    """Of the first effect: it is one of the true ones."""
    return any(among(case, i, 1) for i in range(len(case.label["effects"])))


def said_of_first(case: Scored) -> float:
    """Probability of the first effect, with that of all that no record tells from it: any of them counts as right."""
    first = case.ranked[0]
    good = as_good(case.label, case.found.get("selected") or [], first)
    same = [e for e in case.ranked if e.get("round") == first.get("round")]
    return sum(e["probability"] for e in same if answer(e["kind"], e["place"]) in good)


def first_set(case: Scored) -> list[dict[str, Any]]:
    """The most probable place, with those that it is not told apart from."""
    first = (case.found.get("locations") or [])[:1]
    return [x for y in first for x in y["together"]]


def unknown_found(case: Scored) -> bool:
    """Called unknown, and its place in the first set; of a Hertz contact, or explained there nearly wholly."""
    place = lambda x: same_place(case.label, 0, x["place"])  # noqa: E731
    if case.verdict == "unknown":
        return any(same_place(case.label, 0, x) for x in first_set(case))
    hertz = case.label["effects"][0]["kind"] == "hertz_contact"
    chosen = case.found.get("selected") or []
    closed = (case.found.get("closure") or {}).get("fraction") or 0.0
    return hertz and closed >= 0.95 and bool(chosen) and place(chosen[0])


def wilson(hits: int, count: int) -> tuple[float, float]:
    """Interval of 95 % for a share.

    Args:
        hits: how many.
        count: of how many.

    Source: E. Wilson, J. Amer. Stat. Assoc. 22 (1927).
    """
    if not count:
        return 0.0, 1.0
    z, p = 1.959964, hits / count
    middle, half = p + z**2 / (2 * count), z * np.sqrt(p * (1 - p) / count + z**2 / (4 * count**2))
    low, high = ((middle + side * half) / (1 + z**2 / count) for side in (-1, 1))
    return max(float(low), 0.0), min(float(high), 1.0)  # rounding may lead beyond


def share(chosen: Iterable[Scored], test: Callable[[Scored], bool]) -> dict[str, Any]:
    """Of cases, with its interval.

    Args:
        chosen: cases.
        test: what is counted.
    """
    hits = [bool(test(case)) for case in chosen]
    low, high = wilson(sum(hits), len(hits))
    value = sum(hits) / len(hits) if hits else None
    return {"share": value, "hits": sum(hits), "cases": len(hits), "ci95": [low, high]}


def calibration(rows: list[Scored]) -> dict[str, Any]:
    """Of the first effect's probability: how often it is right, in ten bins, and the mean distance.

    Args:
        rows: cases; where there is no effect of the catalogue any first one is wrong.
    """
    pairs = [(said_of_first(c), first_is_right(c)) for c in rows if c.ranked and "probability" in c.ranked[0]]
    bins = []
    for i in range(BINS):
        inside = [(p, ok) for p, ok in pairs if min(int(p * BINS), BINS - 1) == i]
        if inside:
            p, ok = (float(np.mean(x)) for x in zip(*inside, strict=True))
            bins.append({"said": p, "right": ok, "cases": len(inside)})
    error = sum(b["cases"] * abs(b["said"] - b["right"]) for b in bins) / len(pairs) if pairs else None
    return {"error": error, "bins": bins, "cases": len(pairs)}


def closures(rows: list[Scored]) -> dict[str, Any]:
    """The gap's closure next to an oracle's; what was not closed because nothing was found counts as 0.

    Args:
        rows: cases with effects of the catalogue.
    """
    parts = [(c.found.get("closure") or {}).get("fraction") or 0.0 for c in rows]
    if not any(parts):
        return {"median": None, "lowest_tenth": None, "cases": len(rows)}
    return {
        "median": float(np.median(parts)),
        "lowest_tenth": float(np.quantile(parts, 0.1)),
        "cases": len(parts),
    }


def said_first(case: Scored) -> str:
    """A word for the answer: none, unknown, failure, or the first effect's kind."""
    if case.verdict in ("none", "unknown", "failure") or not case.ranked:
        return case.verdict
    return case.ranked[0]["kind"]


def confusions(rows: list[Scored]) -> dict[str, dict[str, int]]:
    """How often a single effect, or none, is called what; "kind, elsewhere" at another place.

    Args:
        rows: all cases.
    """
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for case in rows:
        if len(case.label["effects"]) > 1:
            continue
        effects = case.label["effects"]
        true = effects[0]["kind"] if effects else "none"
        said = said_first(case)
        same = bool(effects) and said in effects[0]["kinds_right"]
        table[true][f"{said}, elsewhere" if same and not among(case, 0, 1) else said] += 1
    return {true: dict(said) for true, said in sorted(table.items())}


def scored(rows: list[Scored]) -> dict[str, Any]:
    """All figures.

    Args:
        rows: of `cases`.
    """
    single = [c for c in rows if c.truth == "effect" and len(c.label["effects"]) == 1 and c.counts]
    several = [c for c in single if not c.label["one_sensor"]]
    asked = lambda chosen: [c for c in chosen if not c.label["one_sensor"] and c.label["noise"] <= 0.01]  # noqa: E731
    usual = asked(single)
    double = [c for c in rows if len(c.label["effects"]) == 2 and c.counts]
    none = [c for c in rows if c.truth == "none"]
    unknown = [c for c in rows if c.truth == "unknown" and c.counts]
    kinds = sorted({e["kind"] for c in rows for e in c.label["effects"] if c.truth == "effect"})
    first = lambda c: among(c, 0, 1)  # noqa: E731
    # recall of a kind looks at both effects of a case, the first two answers where there are two
    recall = {
        kind: share(
            [c for c in single + double if any(e["kind"] == kind for e in c.label["effects"])],
            lambda c, kind=kind: any(
                among(c, i, len(c.label["effects"]))
                for i, e in enumerate(c.label["effects"])
                if e["kind"] == kind
            ),
        )
        for kind in kinds
    }
    return {
        "cases": len(rows),
        "failures": sum(c.verdict == "failure" for c in rows),
        "first": share(usual, first),
        "first_two": share(usual, lambda c: among(c, 0, 2)),
        "first_at_1_percent": share([c for c in usual if c.label["noise"] == 0.01], first),
        "one_sensor_first": share([c for c in single if c.label["one_sensor"]], first),
        "noise_5_percent_first": share([c for c in several if c.label["noise"] == 0.05], first),
        "false_alarms": share(none, lambda c: c.verdict != "none"),
        "unknown_at_place": share(unknown, unknown_found),
        "unknown_set": float(np.mean([len(first_set(c)) for c in unknown])) if unknown else None,
        "unknown_recall": share(unknown, lambda c: c.verdict == "unknown"),
        "false_unknown": share(single + double, lambda c: c.verdict == "unknown"),
        "missed": share(single + double, lambda c: c.verdict == "none"),
        "both_found": share(double, both),
        "both_alone": share(double, both_alone),
        # in the conditions of the first rows
        "usual_unknown_at_place": share(asked(unknown), unknown_found),
        "usual_false_unknown": share(asked(single + double), lambda c: c.verdict == "unknown"),
        "usual_both_found": share(asked(double), both),
        "calibration": calibration(rows),
        "closure": closures(single + double),
        "deviations": within([p for c in single + double for p in pulls(c.label, c.found)]),
        "seconds": {
            "median": float(np.median([c.seconds for c in rows])) if rows else None,
            "worst": max((c.seconds for c in rows), default=None),
        },
        "recall_by_kind": recall,
        "confusion": confusions(rows),
    }


ROWS = (
    ("right kind at the right place, first", "first", "95 %"),
    ("among the first two", "first_two", "98 %"),
    ("first, 1 % noise only", "first_at_1_percent", ""),
    ("one sensor only, first", "one_sensor_first", "85 %"),
    ("5 % noise, first", "noise_5_percent_first", "90 %"),
    ("false alarms on no effect", "false_alarms", "at most 2 %"),
    ("outside the catalogue: unknown, at its place", "unknown_at_place", "85 %"),
    ("outside the catalogue: unknown, anywhere", "unknown_recall", ""),
    ("known effects called unknown", "false_unknown", "at most 3 %"),
    ("known effects called none", "missed", ""),
    ("two effects, both found", "both_found", "75 %"),
    ("two effects, both found and nothing else", "both_alone", ""),
    (
        "outside the catalogue: unknown, at its place; two sensors or more, at most 1 % noise",
        "usual_unknown_at_place",
        "",
    ),
    ("known effects called unknown, likewise", "usual_false_unknown", ""),
    ("two effects, both found, likewise", "usual_both_found", ""),
)


def percent(x: dict[str, Any]) -> str:
    """A share and its interval.

    Args:
        x: of `share`.
    """
    if x["share"] is None:
        return "no case"
    low, high = (100 * v for v in x["ci95"])
    return f"{100 * x['share']:.1f} % ({low:.0f} to {high:.0f}), {x['hits']} of {x['cases']}"


def shares(x: dict[str, Any]) -> str:
    """Of numbers within their deviations.

    Args:
        x: of `within`.
    """
    if not x["numbers"]:
        return "no number"
    return ", ".join(f"{100 * v:.0f}" for v in x["shares"]) + f" % of {x['numbers']}"


def table(found: dict[str, Any]) -> str:
    """Markdown.

    Args:
        found: of `scored`.
    """
    number = lambda x: "not reported" if x is None else f"{x:.3g}"  # noqa: E731
    lines = ["| | found (95 % interval) | target |", "|---|---|---|"]
    lines += [f"| {text} | {percent(found[name])} | {target} |" for text, name, target in ROWS]
    closure, seconds = found["closure"], found["seconds"]
    lines += [
        f"| expected calibration error | {number(found['calibration']['error'])} | at most 0.05 |",
        f"| places in the first set, outside the catalogue, mean | {number(found['unknown_set'])} | |",
        f"| closure against an oracle, median / lowest tenth | {number(closure['median'])} / "
        f"{number(closure['lowest_tenth'])} | 0.98 / 0.90 |",
        f"| numbers within 1, 2, 3 of their standard deviations | {shares(found['deviations'])} | 68, 95, 99.7 % |",
        f"| time of a diagnosis, median / worst, s | {number(seconds['median'])} / {number(seconds['worst'])} | 45 |",
        f"| failures | {found['failures']} of {found['cases']} | 0 |",
    ]
    if "baselines" in found:
        lines += ["", "| baseline | right kind at the right place | gap closed, median |", "|---|---|---|"]
        for name, x in found["baselines"].items():
            lines.append(
                f"| {name} | {percent(x['first']) if x['first'] else 'names none'} | {number(x['closure'])} |"
            )
    lines += ["", "| kind | found |", "|---|---|"]
    lines += [f"| {kind} | {percent(x)} |" for kind, x in found["recall_by_kind"].items()]
    return "\n".join(lines)


def closed(label: dict[str, Any], x: dict[str, Any]) -> float | None:
    """Part of the second record's gap that a baseline closes, by the contract's formula.

    Args:
        label: tells the noise.
        x: rms before and after, by sensor.
    """
    before, after = (np.array(x[name]) / label["noise_std"] for name in ("before", "after"))
    b, a = (max(float(np.mean(v**2)) - 1, 0.0) for v in (before, after))
    return max(1 - np.sqrt(a / b), 0.0) if b > 0 else None


def baselines(out: Path, rows: list[Scored]) -> dict[str, Any]:
    """Of the simpler methods, on the same single effects.

    Args:
        out: folder of the set.
        rows: cases.
    """
    held: dict[str, list[tuple[Scored, float | None]]] = defaultdict(list)
    for case in rows:
        path = out / "baselines" / f"{case.label.get('case', -1):04d}.json"
        if path.exists() and case.truth == "effect" and len(case.label["effects"]) == 1 and case.counts:
            for name, x in json.loads(path.read_text()).items():
                if name != "failure":
                    answers = case._replace(found={"effects": x.get("effects", [])})
                    held[name].append((answers, closed(case.label, x)))
    found: dict[str, Any] = {}
    for name, pairs in held.items():
        parts = [x for _, x in pairs if x is not None]
        names = any(c.ranked for c, _ in pairs)
        found[name] = {
            "first": share([c for c, _ in pairs], lambda c: among(c, 0, 1)) if names else None,
            "closure": float(np.median(parts)) if parts else None,
        }
    return found


def main() -> None:
    out = Path(sys.argv[1])
    rows = cases(out)
    found = scored(rows)
    if others := baselines(out, rows):
        found["baselines"] = others
    written(out / "score.json", json.dumps(found, indent=1) + "\n")
    print(table(found))


if __name__ == "__main__":
    main()
