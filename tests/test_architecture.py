"""A stage imports only from the stages before it; the order stands in pyproject.toml, import-linter reads the imports."""

from pathlib import Path

from importlinter.api import use_cases


def test_stages_import_only_from_the_stages_before_them(monkeypatch, capsys):
    monkeypatch.chdir(Path(__file__).parents[1])
    assert use_cases.lint_imports(config_filename="pyproject.toml", cache_dir=None), capsys.readouterr().out
