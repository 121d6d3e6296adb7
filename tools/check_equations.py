#!/usr/bin/python3
"""Checks that docs/equations.md and the comments in src/ agree on which code implements which equation.

usage: tools/check_equations.py [ROOT]        ROOT: the repository; default: the one this file lies in

Code names an equation as "Eq. (2)", "eqs. (2) and (3)" or "equations (1) to (3)". The page has a section for each,
"## Eq. (2): ..." or "## Eqs. (5) and (6): ...", with a line that names files and, in brackets, functions in them:

    Code: `src/physics/a.cpp` (`first_function`, `Class::second`), `src/physics/a.hpp`

An equation that nothing implements has the line "Not in the code yet." instead. Reported are mentions without a
section, or whose section does not name the file; named files that do not exist or do not mention the equation; named
functions that their file does not have; and code for what is said not to be there. Exit code 1 if there is any.
"""
import pathlib
import re
import sys

PAGE = "docs/equations.md"
SUFFIXES = {".cpp", ".hpp"}
GAP = r"(?:\s|//+[!<]*)*"  # a comment may break the line anywhere
NUMBER = r"\(\d+\)"
MENTION = re.compile(rf"\b(?:[Ee]qs?\.|[Ee]quations?){GAP}({NUMBER}(?:{GAP}(?:,|and|to){GAP}(?:and{GAP})?{NUMBER})*)")
COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/|\"(?:\\.|[^\"\\\n])*\"", re.DOTALL)
NOT_A_TYPE = r"(?<!\breturn)(?<!\belse)(?<!\bthrow)(?<!\bcase)(?<!\bnew)"
ABSENT = "Not in the code yet."


def numbers(text):
    """{2, 3} of "(2) and (3)", {1, 2, 3} of "(1) to (3)"."""
    found = []
    for before, number in re.findall(r"([^()]*)\((\d+)\)", text):
        if "to" in before and found:
            found += range(found[-1] + 1, int(number))
        found.append(int(number))
    return set(found)


def mentions(text):
    """Pairs of line and set of equation numbers, of a source."""
    return [(text.count("\n", 0, m.start()) + 1, numbers(m[1])) for m in MENTION.finditer(text)]


def has_function(text, name):
    """Whether the source declares or defines the function: its name after a type and before a bracket."""
    code = COMMENT.sub(" ", text)
    return re.search(rf"[\w>&*\]]{NOT_A_TYPE}[\s&*]+(?:\w+::)*{re.escape(name)}\s*\(", code) is not None


class Section:
    def __init__(self, title, line):
        self.title, self.line = title, line
        head = re.match(rf"Eqs?\. ({NUMBER}(?:(?:, | and | to ){NUMBER})*)", title)
        self.equations = numbers(head[1]) if head else set()
        self.files = {}  # name: functions
        self.has_code_line = self.absent = False


def read_page(text):
    """The sections of the page, and what is wrong with its form."""
    sections, problems, fenced = [], [], False
    paragraph = ""
    for number, line in enumerate(text.splitlines() + [""], 1):
        if line.startswith("```"):
            fenced = not fenced
        if fenced:
            continue
        if line.startswith("## "):
            sections.append(Section(line[3:].strip(), number))
        if not sections:
            continue
        if line.strip() == ABSENT:
            sections[-1].absent = True
        if line.startswith("Code:") or paragraph:  # up to the next empty line
            if line.strip():
                paragraph += " " + line
                continue
            sections[-1].has_code_line = True
            items = re.findall(r"`([^`]+)`(?:\s*\(([^()]*)\))?", paragraph)
            if not items:
                problems.append(f"{PAGE}:{number - 1}: a Code line that names no file")
            for file, functions in items:
                names = re.findall(r"`([^`]+)`", functions)
                sections[-1].files.setdefault(file, []).extend(names)
            paragraph = ""
    return sections, problems


def check(root):
    page = (root / PAGE).read_text(encoding="utf-8")
    sections, problems = read_page(page)
    sources = {p.relative_to(root).as_posix(): p.read_text(encoding="utf-8")
               for p in sorted((root / "src").rglob("*")) if p.suffix in SUFFIXES}
    of = {}
    for s in sections:
        for equation in s.equations:
            if equation in of:
                problems.append(f"{PAGE}:{s.line}: a second section for Eq. ({equation})")
            of[equation] = s

    # From the code to the page
    mentioned = {}  # file: set of equations
    for file, text in sources.items():
        mentioned[file] = set()
        for line, found in mentions(text):
            mentioned[file] |= found
            for equation in sorted(found):
                s = of.get(equation)
                if s is None:
                    problems.append(f"{file}:{line}: Eq. ({equation}) has no section in {PAGE}")
                elif s.absent:
                    problems.append(f"{file}:{line}: Eq. ({equation}), of which {PAGE}:{s.line} says: {ABSENT}")
                elif file not in s.files:
                    problems.append(f"{file}:{line}: Eq. ({equation}), but the Code line of {PAGE}:{s.line} does not "
                                    f"name this file")

    # From the page to the code
    for s in sections:
        where = f"{PAGE}:{s.line}: \"{s.title}\""
        if s.absent and s.has_code_line:
            problems.append(f"{where} has a Code line and says: {ABSENT}")
        if s.equations and not s.absent and not s.has_code_line:
            problems.append(f"{where} has neither a Code line nor the line: {ABSENT}")
        for file, functions in s.files.items():
            if file not in sources:
                problems.append(f"{where} names {file}, which does not exist")
                continue
            for equation in sorted(s.equations - mentioned[file]):
                problems.append(f"{where} names {file}, which does not mention Eq. ({equation})")
            for name in functions:
                if not has_function(sources[file], name):
                    problems.append(f"{where} names {name}, which {file} does not have")
    if not mentioned or not any(mentioned.values()):
        problems.append("src: no equation is mentioned anywhere")
    return problems


def main():
    root = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else __file__).resolve()
    if len(sys.argv) < 2:
        root = root.parent.parent
    if not (root / PAGE).is_file() or not (root / "src").is_dir():
        sys.exit(f"check_equations: {root} has no {PAGE} or no src")
    problems = check(root)
    for problem in problems:
        print(problem)
    print(f"check_equations: {len(problems)} problem{'' if len(problems) == 1 else 's'}")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
