"""/api/docs: the OpenAPI document as one plain page. Usual documentation pages load scripts from elsewhere; this origin holds a cookie."""

import json
from html import escape


def docs_page(document: dict) -> str:
    """HTML without scripts."""
    parts = [
        f"<!doctype html><meta charset=utf-8><title>{escape(document['info']['title'])} API</title>",
        "<style>body{font:15px/1.5 system-ui;max-width:60rem;margin:2rem auto;padding:0 1rem}code,pre{background:#f3f3f3;padding:.1em .3em}"
        "pre{overflow:auto;padding:.6em}h2{margin-top:2rem}</style>",
        f"<h1>{escape(document['info']['title'])} API {escape(document['info']['version'])}</h1>",
        "<p>Machine-readable: <a href=/api/openapi.json>/api/openapi.json</a>. The WebSocket protocol is in docs/protocol.md.</p>",
    ]
    for path, methods in document["paths"].items():
        for method, call in methods.items():
            parts.append(
                f"<h2><code>{method.upper()} {escape(path)}</code></h2><p>{escape(call.get('description', call.get('summary', '')))}</p>"
            )
            rows = [
                f"<li><code>{escape(parameter['name'])}</code> ({parameter['in']}{', required' if parameter.get('required') else ''})</li>"
                for parameter in call.get("parameters", [])
            ]
            parts.append(f"<ul>{''.join(rows)}</ul>" if rows else "")
            for kind, body in call.get("requestBody", {}).get("content", {}).items():
                parts.append(f"<p>Body, {escape(kind)}:</p><pre>{escape(json.dumps(body.get('schema', {}), indent=1))}</pre>")
                parts += [_example(title, example) for title, example in body.get("examples", {}).items()]
            for status, answer in call["responses"].items():
                for kind, body in answer.get("content", {}).items() if status != "default" else ():
                    parts.append(f"<p>Answer {status}, {escape(kind)}</p>")
                    parts += [_example(title, example) for title, example in body.get("examples", {}).items()]
    parts.append(f"<h2>Schemas</h2><pre>{escape(json.dumps(document.get('components', {}).get('schemas', {}), indent=1))}</pre>")
    return "".join(parts)


def _example(title: str, example: dict) -> str:
    value = example["value"]
    text = value if isinstance(value, str) else json.dumps(value, indent=1)
    return f"<details><summary>Example: {escape(title)}</summary><pre>{escape(text)}</pre></details>"
