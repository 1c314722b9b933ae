#!/usr/bin/env python3
"""Opens the documentation site in headless Chromium, from disk, as a reader does.

    python3 tests/site.py target/site

Every link to a file or an anchor of the site leads somewhere. Searching for what readers look for finds the right page first.
The sections that are generated have content. Nothing is loaded from the network. Python's standard library and a Chromium are all
that is needed.
"""

import html.parser
import json
import pathlib
import sys
import tempfile
import urllib.parse

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from replay import Browser

# What readers type, and the page that should come first.
SEARCHES = {
    "champion": "explain/glossary.html",
    "leaders that cannot sense": "how-to/blind-leaders.html",
    "Slurm": "how-to/clusters.html",
    "resume": "how-to/resume.html",
    "VectorEnv": "reference/python.html",
}


class Page(html.parser.HTMLParser):
    """The links and anchors of a page."""

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
    # rustdoc checks its own links.
    pages = {path: Page(path) for path in site.rglob("*.html") if site / "rust" not in path.parents and site / "page" not in path.parents}
    for path, page in pages.items():
        for link in page.links:
            parts = urllib.parse.urlsplit(link)
            # The page for wrong addresses belongs to a server's root.
            if parts.scheme or parts.netloc or path.name == "404.html":
                continue
            target = (path.parent / urllib.parse.unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                yield f"{path.relative_to(site)}: {link}"
            elif parts.fragment and target in pages and urllib.parse.unquote(parts.fragment) not in pages[target].anchors:
                yield f"{path.relative_to(site)}: {link} (no such anchor)"
    print(f"links of {len(pages)} pages lead somewhere")


def found_by(browser, site, query):
    """Returns the addresses of the pages that a search finds, best first."""
    browser.open((site / "index.html").as_uri())
    browser.wait("document.querySelector('.md-search__input') !== null")
    browser.evaluate("document.querySelector('[data-md-toggle=search]').click(); document.querySelector('.md-search__input').focus()")
    browser.evaluate(
        f"(() => {{ const e = document.querySelector('.md-search__input'); e.value = {json.dumps(query)};"
        " e.dispatchEvent(new KeyboardEvent('keyup', { key: 'a', bubbles: true })); })()"
    )
    browser.wait("document.querySelectorAll('.md-search-result__item > .md-search-result__link').length > 0")
    links = browser.evaluate("[...document.querySelectorAll('.md-search-result__item > .md-search-result__link')].map(link => link.href)")
    root = (site / "index.html").as_uri().removesuffix("index.html")
    return [link.split("?")[0].split("#")[0].removeprefix(root) for link in links]


def main():
    site = pathlib.Path(sys.argv[1]).resolve()
    broken = list(broken_links(site))
    assert not broken, "links lead nowhere:\n" + "\n".join(broken)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(profile)
        browser.window(1280, 900, dark=False)
        wrong = []
        for query, page in SEARCHES.items():
            found = found_by(browser, site, query)
            print(f"search for {query!r}: {', '.join(found[:3])}")
            if found[:1] != [page]:
                wrong.append(query)
        assert not wrong, f"another page comes first: {wrong}"
        for page, selector in {
            "reference/python.html": "[id='flotilla.VectorEnv.step']",
            "reference/rust.html": "a[href='../rust/flotilla/index.html']",
            "rust/flotilla/index.html": "#modules",
            "reference/commands.html": "#flotilla-train",
            "how-to/browser.html": "a[href='../page/index.html']",
            "page/index.html": "#train",
        }.items():
            browser.open((site / page).as_uri())
            assert browser.evaluate(f"document.querySelector({json.dumps(selector)}) !== null"), f"{page} has no {selector}"
            asked = [event["params"]["request"]["url"] for event in browser.events if event["method"] == "Network.requestWillBeSent"]
            outside = [url for url in asked if not url.startswith(("file:", "data:", "blob:", "about:"))]
            assert not outside, f"{page} asks the network for {outside}"
        print("generated sections are there, and nothing asks the network")
        browser.close()


main()
