"""What benchmarks print can be read on any terminal."""

import pytest

from benchmarks._harness import report


@pytest.mark.parametrize(("width", "as_table"), [(200, True), (80, False)])
def test_figures_are_shown_whole_at_any_width(width, as_table, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(width))
    figures = {f"figure_with_a_long_name_{i}": 1000.5 + i for i in range(4)}
    report("wide", {"one case": figures, "another": figures}, as_json=False)
    shown = capsys.readouterr().out
    assert all(name in shown for name in figures) and "1,004" in shown and "…" not in shown
    assert "another" in shown and ("┃" in shown) == as_table
