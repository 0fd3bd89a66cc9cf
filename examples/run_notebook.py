"""Run notebooks from top to bottom and write into them what their cells show. It needs no Jupyter.

python examples/run_notebook.py NOTEBOOK.ipynb ...

Each notebook gets names of its own, in this process. A cell shows what it prints and, as in Jupyter, the value of its last line: as picture or HTML
where that offers one. What `_repr_..._` methods give and the fields of the file are Jupyter's (nbformat 4).
"""

import argparse
import ast
import base64
import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notebooks", type=Path, nargs="+")
    for path in parser.parse_args(arguments).notebooks:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        run_notebook(notebook, path.name)
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def run_notebook(notebook: dict[str, Any], name: str) -> None:
    """Run the code of its cells and put in place what they show.

    Raises:
        Whatever a cell raises.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(cells, 1):
        printed = io.StringIO()
        with redirect_stdout(printed):
            value = _run("".join(cell["source"]), names, f"{name}[{number}]")
        cell["execution_count"], cell["outputs"] = number, []
        if printed.getvalue():
            cell["outputs"].append({"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(keepends=True)})
        if value is not None:
            shown = {"output_type": "execute_result", "execution_count": number, "metadata": {}, "data": shown_as(value)}
            cell["outputs"].append(shown)


def _run(source: str, names: dict[str, Any], name: str) -> Any:
    """The value of the last line; None where that is no expression, or ends in a semicolon."""
    code = ast.parse(source, name)
    last = code.body.pop() if code.body and isinstance(code.body[-1], ast.Expr) else None
    exec(compile(code, name, "exec"), names)
    if last is None:
        return None
    assert isinstance(last, ast.Expr)
    value = eval(compile(ast.Expression(last.value), name, "eval"), names)
    return None if source.rstrip().endswith(";") else value


def shown_as(value: Any) -> dict[str, Any]:
    """A value by kind of media: its text, and pictures (base64) and HTML where it offers them."""
    shown: dict[str, Any] = {"text/plain": repr(value).splitlines(keepends=True)}
    for kind, method in (("image/png", "_repr_png_"), ("image/jpeg", "_repr_jpeg_"), ("text/html", "_repr_html_")):
        offered = getattr(value, method, lambda: None)()
        if isinstance(offered, bytes):
            shown[kind] = base64.b64encode(offered).decode()
        elif offered is not None:
            shown[kind] = offered.splitlines(keepends=True)
    return shown


if __name__ == "__main__":
    main()
