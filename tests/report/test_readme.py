"""The README's example runs as printed."""

import re
from pathlib import Path

README = Path(__file__).parents[2] / "README.md"


def test_the_example_of_the_readme_runs_and_finds_the_circle(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(code, str(README), "exec"), names)
    assert "radius_mm" in capsys.readouterr().out
    posterior = names["posterior"]
    distance = (posterior.mean()[:2] - [600.0, 260.0]) / posterior.sd()[:2]
    assert abs(distance).max() < 4
