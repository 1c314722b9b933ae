#!/usr/bin/env python3
"""Tests the documentation site, in headless Chromium and from disk.

    python3 tests/site.py target/site

All links to files and anchors of the site must exist. Searches for common terms must find the right page first.
Generated sections must have content. Nothing may be loaded from the network. Needs Python's standard library and
Chromium.
"""

import html.parser
import json
import pathlib
import sys
import tempfile
import urllib.parse

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from replay import Browser

# Searches, and the page that must come first.
SEARCHES = {
    "champion": "explain/glossary.html",
    "leaders that cannot sense": "how-to/blind-leaders.html",
    "Slurm": "how-to/clusters.html",
    "resume": "how-to/resume.html",
    "VectorEnv": "reference/python/environments.html",
}


class Page(html.parser.HTMLParser):
    """Parses the links and anchors of a page."""

    def __init__(self, path):
        super().__init__()
        self.links, self.anchors = [], set()
        self.feed(path.read_text())

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            if name in ("href", "src") and value and tag != "base":
                self.links.append(value)


def broken_links(site):
    """Yields the broken links of all pages except rustdoc's, which rustdoc checks, and the browser page."""
    excluded = {site / "rust", site / "page"}
    pages = {path: Page(path) for path in site.rglob("*.html") if excluded.isdisjoint(path.parents)}
    for path, page in pages.items():
        for link in page.links:
            parts = urllib.parse.urlsplit(link)
            # The links of 404.html are relative to the root of a server.
            if parts.scheme or parts.netloc or path.name == "404.html":
                continue
            target = (path.parent / urllib.parse.unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                yield f"{path.relative_to(site)}: {link}"
                continue
            anchor = urllib.parse.unquote(parts.fragment)
            if anchor and target in pages and anchor not in pages[target].anchors:
                yield f"{path.relative_to(site)}: {link} (no such anchor)"
    print(f"checked the links of {len(pages)} pages")


def search(browser, site, query):
    """Returns the addresses of the pages that a search finds, best first."""
    browser.open((site / "index.html").as_uri())
    browser.wait("document.querySelector('.md-search__input') !== null")
    browser.evaluate(
        "document.querySelector('[data-md-toggle=search]').click(); document.querySelector('.md-search__input').focus()"
    )
    browser.evaluate(
        f"(() => {{ const e = document.querySelector('.md-search__input'); e.value = {json.dumps(query)};"
        " e.dispatchEvent(new KeyboardEvent('keyup', { key: 'a', bubbles: true })); })()"
    )
    results = "document.querySelectorAll('.md-search-result__item > .md-search-result__link')"
    browser.wait(f"{results}.length > 0")
    links = browser.evaluate(f"[...{results}].map(link => link.href)")
    root = (site / "index.html").as_uri().removesuffix("index.html")
    return [link.split("?")[0].split("#")[0].removeprefix(root) for link in links]


def main():
    site = pathlib.Path(sys.argv[1]).resolve()
    broken = list(broken_links(site))
    assert not broken, "broken links:\n" + "\n".join(broken)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(profile)
        browser.window(1280, 900, dark=False)
        wrong = []
        for query, page in SEARCHES.items():
            results = search(browser, site, query)
            print(f"search for {query!r}: {', '.join(results[:3])}")
            if results[:1] != [page]:
                wrong.append(query)
        assert not wrong, f"these searches find another page first: {wrong}"
        for page, selector in {
            "reference/python/environments.html": "[id='flotilla.VectorEnv.step']",
            "reference/rust.html": "a[href='../rust/flotilla/index.html']",
            "rust/flotilla/index.html": "#modules",
            "reference/commands.html": "#flotilla-train",
            "how-to/browser.html": "a[href='../page/index.html']",
            "page/index.html": "#train",
        }.items():
            browser.open((site / page).as_uri())
            exists = browser.evaluate(f"document.querySelector({json.dumps(selector)}) !== null")
            assert exists, f"{page} has no {selector}"
            requests = [event["params"] for event in browser.events if event["method"] == "Network.requestWillBeSent"]
            urls = [request["request"]["url"] for request in requests]
            external = [url for url in urls if not url.startswith(("file:", "data:", "blob:", "about:"))]
            assert not external, f"{page} loads from the network: {external}"
        print("generated sections have content, and no page loads from the network")
        browser.close()


main()
