"""Writes docs/benchmarks.md from the result files beside this one: `make results-page`.

Each `*.yaml` is a section: its tables hold entries (measure, required, measured, command), or lines as they stand, or
rows of `ballfg-bench` from a `*.json` here. `--take RESULTS.json ...` first puts new values into those rows.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

HERE = Path(__file__).parent
PAGE = HERE.parent / "benchmarks.md"
ENTRY = ("measure", "required", "measured", "command")
NUMBERS = ("unit", "value", "low", "high", "n")
KEY = ("case", "method", "metric")


def page() -> str:
    """The whole page, as Markdown."""
    sections = [yaml.safe_load(path.read_text(encoding="utf-8")) for path in sorted(HERE.glob("*.yaml"))]
    return "\n\n".join(part for section in sections for part in _section(section)) + "\n"


def take(files: list[Path]) -> int:
    """Put the numbers of `results.json` files into the rows of this folder. Returns: how many rows were found."""
    new = {_key(row): row for file in files for row in json.loads(file.read_text(encoding="utf-8"))["rows"]}
    found = 0
    for path in HERE.glob("*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        for row in content["rows"]:
            if _key(row) in new:
                row.update({name: new[_key(row)][name] for name in NUMBERS})
                found += 1
        path.write_text(_rows_text(content), encoding="utf-8")
    return found


def _section(section: dict[str, Any]) -> Iterator[str]:
    yield section["title"]
    yield f"{section.get('text', '')} Measured {section['measured']}.".replace("\n ", " ").strip()
    for table in section.get("tables", ()):
        if "text" in table:
            yield table["text"].strip()
        lines = _lines(table)
        head, *rest = ("| " + " | ".join(line) + " |" for line in lines)
        yield "\n".join((head, "|" + "---|" * len(lines[0]), *rest))
    if "after" in section:
        yield section["after"].strip()


def _lines(table: dict[str, Any]) -> list[list[str]]:
    """Heads and cells of a table."""
    if "entries" in table:
        return [
            ["measure", "required", "measured", "made by"],
            *([one[name] for name in ENTRY] for one in table["entries"]),
        ]
    if "rows" not in table:
        return [[str(cell) for cell in line] for line in table["lines"]]
    rows = {_key(row): row for row in json.loads((HERE / table["rows"]).read_text(encoding="utf-8"))["rows"]}
    lines = [["", "required", *table["columns"].values()]]
    for line in table["lines"]:
        metrics = line["metric"] if isinstance(line["metric"], list) else [line["metric"]]
        of_method = [
            [(line.get("case", table.get("case")), name, metric) for metric in metrics] for name in table["columns"]
        ]
        cells = (" / ".join(_cell(rows[key], line) for key in keys if key in rows) for keys in of_method)
        lines.append([line["measure"], line.get("required", ""), *cells])
    return lines


def _cell(row: dict[str, Any], line: dict[str, Any]) -> str:
    """A value, with its interval where the line has a requirement."""
    times = line.get("times", 1)
    value, low, high = (None if row[name] is None else f"{times * row[name]:.3g}" for name in ("value", "low", "high"))
    return f"{value} ({low} - {high})" if low and high and line.get("required") else str(value)


def _key(row: dict[str, Any]) -> tuple[str, ...]:
    return tuple(row[name] for name in KEY)


def _rows_text(content: dict[str, Any]) -> str:
    """JSON with a line for each row."""
    head = json.dumps({name: value for name, value in content.items() if name != "rows"}, indent=1)[:-2]
    return head + ',\n "rows": [\n  ' + ",\n  ".join(json.dumps(row) for row in content["rows"]) + "\n ]\n}\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--take", type=Path, nargs="+", default=[], metavar="RESULTS.json")
    files = parser.parse_args().take
    if files:
        print(f"{take(files)} rows taken")
    PAGE.write_text(page(), encoding="utf-8")
