"""
Pages that `make docs` makes.

The README as first page, other pages of the root, and one page of the Python interface per package.
"""

import ast
import re
import shutil
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    'index.md': 'README.md',
    'CONTRIBUTING.md': 'CONTRIBUTING.md',
    'SECURITY.md': 'SECURITY.md',
}
"""Page of the site -> file of the repository."""
STYLE = '.md-typeset pre > code { white-space: pre-wrap; overflow-wrap: anywhere; }'
"""Long commands continue on the next line: none is cut off at the edge."""
SKIPPED = {'__main__'}
LOADED = re.compile(r'<(script|img|link|iframe)[^>]*\b(src|href)="?https?://')
LINK = re.compile(r'(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)]*)?\)')


def on_files(files, config):
    """Add the generated pages."""
    for page, path in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / path).read_text()))
    for page, content in (interface() | {'commands.css': STYLE}).items():
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown, page, **_):
    """
    Lead links to the page in the site; a link to another file of the repository becomes its name.
    """
    here = (
        ROOT / PAGES[page.file.src_uri]
        if page.file.src_uri in PAGES
        else ROOT / 'docs' / page.file.src_uri
    )
    places = {(ROOT / path).resolve(): name for name, path in PAGES.items()}

    def led(match):
        image, text, target, anchor = match.groups()
        path = (here.parent / target).resolve()
        if ':' in target or not path.exists():
            return match.group()  # a dead link is then a warning
        if path in places or (ROOT / 'docs') in path.parents and path.is_file():
            name = places.get(path) or path.relative_to(ROOT / 'docs').as_posix()
            up = '../' * page.file.src_uri.count('/')
            return f'{image}[{text}]({up}{name}{anchor or ""})'
        return text

    return LINK.sub(led, markdown)


def on_post_page(output, page, **_):
    """
    Replace the script that the theme would load from another host.

    For search in pages opened from files.
    """
    up = '../' * page.file.src_uri.count('/')
    return re.sub(
        r'<script src="?https://unpkg.com/iframe-worker/shim"?>',
        f'<script src="{up}worker.js">',
        output,
    )


def on_post_build(config):
    """Copy that script; end if a page still requests another host."""
    site = Path(config.site_dir)
    shutil.copy(ROOT / 'tools/docs_worker.js', site / 'worker.js')
    (site / '404.html').unlink()  # for servers only, and with that script
    found = [path.name for path in site.rglob('*.html') if LOADED.search(path.read_text())]
    if found:
        raise SystemExit(f'pages must load nothing from other hosts, these do: {", ".join(found)}')


def interface():
    """
    Return {page: text} with one page per package and one section per module that has public names.
    """
    pages = {}
    packages = sorted(path.parent for path in (ROOT / 'imu_calibration').glob('*/__init__.py'))
    for folder in [ROOT / 'imu_calibration', ROOT / 'msg_adapters', *packages]:
        package = '.'.join(folder.relative_to(ROOT).parts)
        found = sorted(
            folder.glob('*.py') if folder.name == 'imu_calibration' else folder.rglob('*.py')
        )
        modules = [
            '.'.join(path.relative_to(ROOT).with_suffix('').parts)
            for path in found
            if path.stem not in SKIPPED
            and path.name != '__init__.py'
            and path.stem.isidentifier()
            and public(path)
        ]
        if modules:
            pages[f'api/{package}.md'] = (
                '\n\n'.join([f'# {package}', *(f'::: {module}' for module in modules)]) + '\n'
            )
    links = '\n'.join(f'- [{Path(page).stem}]({Path(page).name})' for page in pages)
    return {
        'api/index.md': (
            '# Python interface\n\nPublic functions and classes, from their docstrings. Start with'
            f' [api](imu_calibration.api.md).\n\n{links}\n'
        )
    } | pages


def public(path):
    """Return whether a module has public functions or classes."""
    defined = [
        node.name
        for node in ast.parse(path.read_text()).body
        if isinstance(node, (ast.FunctionDef, ast.ClassDef))
    ]
    return any(not name.startswith('_') for name in defined)
