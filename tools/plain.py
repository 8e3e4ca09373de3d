#!/usr/bin/env python3
"""
Count marker words in docstrings, comments, messages and pages.

Words that technical English rarely needs; fail above a limit.

Usage: `plain.py [ROOT] [--folders] [--worst N]`; ROOT is a folder or one file. A marker is frequent
in sentences with one of four habits: a clause in place of a noun ("what is left" for "the
residual"), data that speak ("the windows say"), a common verb in place of the technical one ("goes
with" for "correlates with"), and a vague pronoun. Good packages have 0.5 to 5 per 1,000 words.
"""

import argparse
import ast
import collections
import dataclasses
import io
import pathlib
import re
import sys
import tokenize

MOST = {'docstring': 6.0, 'comment': 6.0, 'message': 8.0, 'page': 10.0}
"""
Largest number of markers per 1,000 words of each kind of text; lower it when the rate has fallen,
never raise it.
"""
MOST_WORDS = {
    'README.md': 900,
    'docs/turntable.md': 900,
    'docs/planning.md': 900,
    'docs/units-axes-files.md': 600,
    'docs/own-effects.md': 500,
    'docs/decisions/*.md': 250,
}
"""Largest number of words of a page."""
MARKERS = set(
    """
what whatever whoever whose nobody nothing everything everybody somebody hardly anew strange alone
else others those say says said tell tells told ask asks asked speak speaks spoken answer answers
answered know knows let lets beside behind apart far whole stay stays stayed come comes came go
goes went gone stand stands stood leave leaves take takes took taken look looks looked word words
people chance chances story say-so
""".split()
)
SENTENCE = re.compile(r'(?<=[.!?;:])\s+')
CODE = re.compile(
    r'```.*?```|``[^`]*``|`[^`]*`|https?://\S+|<style.*?</style>|\{[{%].*?[}%]\}|<[^>]+>', re.S
)


def texts(path):
    """Yield (kind, line, text) of one Python or Markdown file or HTML template."""
    source = path.read_text(encoding='utf8')
    if path.suffix != '.py':
        for number, line in enumerate(
            CODE.sub(lambda m: '\n' * m.group().count('\n'), source).splitlines(), 1
        ):
            if line.strip() and not line.lstrip().startswith('|'):
                yield 'message' if path.suffix == '.html' else 'page', number, line
        return
    tree = ast.parse(source)
    bare = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    inside = {id(v) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for v in n.values}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in inside
        ):
            if id(node) in bare:
                yield 'docstring', node.lineno, CODE.sub(' ', node.value)
            elif len(node.value.split()) > 3:
                yield 'message', node.lineno, CODE.sub(' ', node.value)
        elif isinstance(node, ast.JoinedStr):
            text = ''.join(
                str(v.value) if isinstance(v, ast.Constant) else ' X ' for v in node.values
            )
            if len(text.split()) > 3:
                yield 'message', node.lineno, CODE.sub(' ', text)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield 'comment', token.start[0], CODE.sub(' ', token.string.lstrip('#! '))


def files(root):
    """Return the product's Python files and the pages."""
    if root.is_file():
        return [root]
    skip = {'test', 'build', 'install', 'validation', 'tools', 'site', 'demo'}
    found = [
        path
        for pattern in ('*.py', '*.html')
        for path in root.rglob(pattern)
        if not any(part in skip or part.startswith('.') for part in path.relative_to(root).parts)
    ]
    found += [p for p in [root / 'README.md', root / 'CONTRIBUTING.md'] if p.exists()]
    return sorted(found) + sorted((root / 'docs').rglob('*.md'))


@dataclasses.dataclass
class Count:
    """Words and markers of some sentences."""

    words: int = 0
    """Number of words."""
    markers: int = 0
    """Number of marker words."""
    long: int = 0
    """Number of sentences above 30 words."""

    def add(self, words, markers):
        """Count a sentence."""
        self.words += words
        self.markers += markers
        self.long += words > 30

    @property
    def rate(self):
        """Markers per 1,000 words."""
        return 1000 * self.markers / max(self.words, 1)

    def line(self, name):
        """Return the printed line of these sentences."""
        return (
            f'{name:34s} {self.words:7d} words {self.rate:6.1f} markers per 1,000 '
            f' {self.long:4d} sentences above 30 words'
        )


def main():
    """Print the rate by folder and by kind of text."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('root', nargs='?', default='.', type=pathlib.Path)
    parser.add_argument(
        '--worst', type=int, default=0, help='print the N sentences with most markers'
    )
    parser.add_argument('--folders', action='store_true', help='print the rate of each folder')
    arguments = parser.parse_args()
    by_kind = collections.defaultdict(Count)
    by_place = collections.defaultdict(Count)
    sentences = []  # (share of markers, place, sentence) of each with several markers
    for path in files(arguments.root):
        place = path.name
        if arguments.root.is_dir():
            place = '/'.join(path.relative_to(arguments.root).parts[:2])
        for kind, line, text in texts(path):
            for sentence in SENTENCE.split(text):
                words = re.findall(r"[A-Za-z][A-Za-z'-]*", sentence)
                n_markers = sum(word.lower() in MARKERS for word in words)
                by_kind[kind].add(len(words), n_markers)
                by_place[place].add(len(words), n_markers)
                if n_markers > 1:
                    share = n_markers / (len(words) + 8)
                    sentences.append((share, f'{path}:{line}', ' '.join(sentence.split())))

    if arguments.folders:
        for place, count in sorted(by_place.items(), key=lambda item: -item[1].markers):
            print(count.line(place))
    for _, place, sentence in sorted(sentences, reverse=True)[: arguments.worst]:
        print(f'  {place}: {sentence[:200]}')
    total = Count()
    for kind in ('docstring', 'comment', 'message', 'page'):
        if kind in by_kind:
            print(by_kind[kind].line(kind))
            total.words += by_kind[kind].words
            total.markers += by_kind[kind].markers
            total.long += by_kind[kind].long
    print(total.line('total'))

    # The limits are those of the whole repository.
    if not arguments.root.is_dir():
        return
    faults = []
    for kind, count in by_kind.items():
        if count.rate > MOST[kind]:
            faults.append(
                f'marker words per 1,000 words in {kind}s must be at most {MOST[kind]:g}, got'
                f' {count.rate:.2f}; rewrite the sentences that `tools/plain.py --worst 20` prints'
            )
    for pattern, most in MOST_WORDS.items():
        for path in sorted(arguments.root.glob(pattern)):
            n_words = len(path.read_text().split())
            if n_words > most:
                faults.append(
                    f'{path.relative_to(arguments.root)} must have at most {most} words, got'
                    f' {n_words}; shorten it'
                )
    if faults:
        sys.exit('\n'.join(faults))


if __name__ == '__main__':
    main()
