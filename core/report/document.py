"""One self-contained HTML document: style, pictures and graphs inside, no network. Readable in dark mode, on paper and on a phone."""

import base64
import hashlib
import html
from collections.abc import Iterable

STYLE = """
:root{color-scheme:light dark;--paper:#fff;--ink:#222;--soft:#666;--line:#ddd;--note:#fff3d0;--box:#f5f5f5;--good:#1e8449;--bad:#b03a2e}
@media (prefers-color-scheme:dark){:root{--paper:#1b1d20;--ink:#e4e4e4;--soft:#a0a0a0;--line:#3c4046;--note:#4a3f1c;--box:#26292d;
--good:#58d68d;--bad:#ec7063}}
*{box-sizing:border-box}body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:0 auto;padding:1em;color:var(--ink);
background:var(--paper);overflow-wrap:anywhere}h1{margin:.2em 0}h2{margin:1.6em 0 .5em}img,svg{max-width:100%;height:auto}
figure{margin:0;min-width:0}figcaption{color:var(--soft);font-size:13px}.row{display:grid;gap:1em;
grid-template-columns:repeat(auto-fit,minmax(min(100%,320px),1fr));margin:1em 0}.cells{gap:.4em;
grid-template-columns:repeat(auto-fill,minmax(min(30%,120px),1fr))}.graphs{
grid-template-columns:repeat(auto-fit,minmax(min(100%,440px),1fr))}.wide{overflow-x:auto}
.single{grid-template-columns:1fr}.broad{grid-template-columns:repeat(auto-fill,minmax(min(100%,440px),1fr))}
figure img{width:100%}.strip{display:grid;grid-template-columns:max-content minmax(0,1fr);gap:4px .8em;font-size:13px;line-height:18px}
.strip>span{text-align:right}.strip svg{width:100%;height:18px}.strip div{display:flex;justify-content:space-between}
.strip div:last-child{flex-wrap:wrap;justify-content:flex-start;gap:0 1em}
.strip div:last-child span{display:flex;align-items:flex-end;gap:.4em}
.strip i{width:22px;print-color-adjust:exact}
table{border-collapse:collapse;overflow-wrap:normal}
td,th{padding:.2em .8em .2em 0;text-align:left;border-bottom:1px solid var(--line);vertical-align:top}
.note{background:var(--note);padding:.4em .8em;margin:.4em 0}.soft{color:var(--soft)}.good{color:var(--good)}.bad{color:var(--bad)}
.first{display:grid;gap:1em;grid-template-columns:repeat(auto-fit,minmax(min(100%,380px),1fr));margin:1em 0}.stage[hidden]{display:none}
.stage img{display:block;width:100%;max-height:520px;object-fit:contain;object-position:left}.stage output{font-size:13px}
.stage div{display:flex;gap:.6em;padding:.4em 0}.stage input{flex:1;min-width:0}.legend{font-size:13px;margin-bottom:1em}
.legend i{display:block;height:10px;print-color-adjust:exact}.legend div{display:flex;justify-content:space-between}
.strip svg,.cells figure{cursor:pointer}nav{margin:1.2em 0}a{color:inherit}.row:not(.cells) figure img{cursor:zoom-in}
.row figure.large{grid-column:1/-1}figure.large img{cursor:zoom-out}
.verdict{font-size:1.2em;margin:.4em 0}summary{cursor:pointer;font-weight:600;margin:.6em 0}pre{white-space:pre-wrap;
overflow-wrap:anywhere;background:var(--box);padding:.6em}svg{color:var(--ink);background:none}
@media screen and (max-width:700px){.single figure{overflow-x:auto}.single img{width:auto;max-width:none;height:340px}}
@media print{:root{--paper:#fff;--ink:#000;--soft:#444;--line:#bbb;--note:#eee;--box:#f5f5f5}body{max-width:none;font-size:11pt}
.row:not(.single,.broad,.cells){grid-template-columns:repeat(3,1fr)}.row.graphs{grid-template-columns:1fr 1fr}h2,summary{break-after:avoid}
figure,svg,tr{break-inside:avoid}.stage,nav{display:none}.now{visibility:hidden}}
"""

SCRIPT = """
for (const picture of document.querySelectorAll('.row:not(.cells) figure img')) {
  picture.title = 'Click to enlarge'
  picture.addEventListener('click', () => picture.parentNode.classList.toggle('large'))
}
addEventListener('beforeprint', () => document.querySelectorAll('details').forEach(d => { d.open = true }))
"""


def document(title: str, body: str, script: str = "") -> str:
    """The page. `title` is text, `body` HTML, `script` JavaScript of our own. Its policy lets a browser run that script alone, and load
    nothing."""
    code = f"<script>{script}</script>" if script else ""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f'<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>{body}{code}</body></html>\n"
    )


def figure(caption: str, picture: bytes, kind: str = "jpeg") -> str:
    """A picture (JPEG or PNG) with its caption, which is its alternative text, too."""
    text = html.escape(caption)
    data = base64.b64encode(picture).decode()
    return f'<figure><img alt="{text}" src="data:image/{kind};base64,{data}"><figcaption>{text}</figcaption></figure>'


def notes(sentences: Iterable[str]) -> str:
    """Warnings."""
    return "".join(f'<p class="note">{html.escape(sentence)}</p>' for sentence in sentences)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of HTML cells; the first of each row is its heading. It scrolls by itself on a narrow screen."""
    top = "".join(f"<th>{cell}</th>" for cell in head)
    body = "".join(f"<tr><th>{first}</th>{''.join(f'<td>{cell}</td>' for cell in rest)}</tr>" for first, *rest in rows)
    return f'<div class="wide"><table><tr>{top}</tr>{body}</table></div>'
