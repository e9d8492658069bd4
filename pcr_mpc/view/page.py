"""The page: its files put together into one that needs no other."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import Any

_FOLDER = Path(__file__).parent / "page"
_STYLES = ("style.css",)
_SCRIPTS = ("link.js", "layers.js", "canvas.js", "strips.js", "panel.js", "hands.js", "main.js")


def page(data: dict[str, Any] | None = None) -> str:
    """Return the page as one HTML document.

    Parameters
    ----------
    data : dict, optional
        A recorded run (see `replay`). None: the page asks the server that it comes from.
    """
    nonce = secrets.token_urlsafe(12)
    source = "'none'" if data is not None else "'self'"
    policy = (
        f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src {source}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    styles = "\n".join(f'<style nonce="{nonce}">\n{_text(name)}</style>' for name in _STYLES)
    scripts = "\n".join(f'<script nonce="{nonce}">\n{_text(name)}</script>' for name in _SCRIPTS)
    # "</" would end the element, whatever it stands in.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    held = f'<script type="application/json" id="data" nonce="{nonce}">{text}</script>'
    parts = {"policy": policy, "styles": styles, "data": held, "scripts": scripts}
    html = _text("page.html")
    for name, part in parts.items():
        html = html.replace(f"<!--{name}-->", part, 1)
    return html


def _text(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")
