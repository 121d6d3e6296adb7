#!/usr/bin/python3
"""Bad input is refused: exit code 2, every problem named with file, line, key and what was expected, and not a file
touched. The inputs are in malformed/, what is said about them in malformed/expected.toml."""
import os
import re
import sys
import tomllib
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import PROGRAM, Failure, require, run, say, scratch, snapshot

FOLDER = Path(__file__).parent / "malformed"
SCENE = ("[run]\nend_time_tau0 = 1\n[mesh]\ndim = 2\nsize_W0 = [64, 64]\n"
         "[[seed]]\nposition_W0 = [32, 32]\nradius_W0 = 8\n")
MEGA = 1_000_000


def generated(folder):
    """Inputs that are too large, or too odd, to be kept as files; name -> path."""
    wrong = SCENE.replace("dim = 2", "dim = 5")
    contents = {
        "binary": PROGRAM.read_bytes()[:4096],
        "control_characters": bytes(range(1, 256)),
        "nul_byte_in_text": SCENE.replace("dim = 2", "dim = 2\0").encode(),
        "utf_16": SCENE.encode("utf-16"),
        "latin_1": b'[run]\ntitle = "d\xe9j\xe0 vu"\n',
        "no_break_space": SCENE.replace("dim = 2", "dim =\u00a02").encode(),
        "windows_lines": wrong.replace("\n", "\r\n").encode(),  # fine as such: the error is on the right line
        "byte_order_mark": b"\xef\xbb\xbf" + wrong.encode(),    # likewise
        "old_mac_lines": SCENE.replace("\n", "\r").encode(),
        "long_key": (SCENE + "k" * (10 * MEGA) + " = 1\n").encode(),
        "long_text": SCENE.replace("= 1\n", f'= "{"x" * (10 * MEGA)}"\n', 1).encode(),
        "long_list": SCENE.replace("[64, 64]", f"[{'1,' * (5 * MEGA)}]").encode(),
        "long_words": b"x " * (5 * MEGA),
        "long_open_string": (SCENE + '[output]\ndir = "' + "x" * (10 * MEGA) + "\n").encode(),
        "too_large": (SCENE + "#" * (17 * MEGA)).encode(),
        "deep_lists": b"a = " + b"[" * MEGA,
        "deep_tables": b"a = " + b"{a=" * MEGA,
        "dotted_key": b"a" + b".a" * MEGA + b" = 1\n",
        "forbidden": SCENE.encode()}
    paths = {}
    for name, content in contents.items():
        paths[name] = folder / f"{name}.toml"
        paths[name].write_bytes(content)
    paths["forbidden"].chmod(0)
    for name in ("folder", "missing", "dangling_link", "circular_link"):
        paths[name] = folder / f"{name}.toml"
    paths["folder"].mkdir()
    paths["dangling_link"].symlink_to("nowhere")
    paths["circular_link"].symlink_to("circular_link.toml")
    return paths


class Refusal:
    """A folder to work in, with the output of an earlier run; nothing in it may change."""

    def __init__(self):
        self.failures = []
        self.make_folder()

    def make_folder(self):
        self.folder = scratch()
        out = self.folder / "out"  # the default of output.dir
        out.mkdir()
        for name in ("plt_0000000.hdf", "plt.hdf.series", "chk_0000010.h5", "diagnostics.csv", "tips.csv",
                     "manifest.json"):
            (out / name).write_text(f"an earlier run's {name}\n")
        self.before = snapshot(self.folder)

    def check(self, name, words, file, problems, **options):
        try:
            self.check_one(words, file, problems, **options)
        except Failure as failure:  # on to the next one: many cases, little time each
            self.failures.append(name)
            say(f"{name}: {failure}")
            self.make_folder()

    def check_one(self, words, file, problems, **options):
        result = run(*words, code=2, cwd=self.folder, timeout=60, **options)
        require(snapshot(self.folder) == self.before, f"files were touched by {result}")
        require(len(result.out + result.err) < 20_000, f"a message of {len(result.out + result.err)} characters")
        compare(file, problems, result)


def compare(file, problems, result):
    """The paragraphs of the message against what is expected of them."""
    text = result.err
    count = re.findall(r"^dendrift: (\d+) problems? in the input$", text, re.M)
    require(len(count) == 1, f"{len(count)} messages where one was expected: {result}")
    text = text[text.index(" in the input"):].split("-----")[0]  # mpirun's own words come after a rule
    found = []
    for part in text.split("\n\n")[1:]:
        place = part.lstrip("\n").split("\n")[0]
        for label in ("expected:", "found:"):
            require(f"\n  {label}" in part, f"no '{label}' in the paragraph\n{part}")
        if place.startswith("command line"):
            line, key = -1, place[len("command line"):]
        else:
            require(place.startswith(str(file)), f"the problem does not name {file}: {place}")
            match = re.fullmatch(r"(?::(\d+))?((?:: .*)?)", place[len(str(file)):])
            require(match, f"unclear place of the problem: {place}")
            line, key = int(match[1] or 0), match[2]
        found.append((line, key.removeprefix(": "), part))
    require(int(count[0]) == len(found), f"{count[0]} problems announced, {len(found)} named: {result}")
    for line, key, *words in problems:
        fits = [p for p in found if p[:2] == (line, key) and all(w in p[2] for w in words)]
        require(fits, f"no problem at line {line}, key '{key}', with the words {words}: {result}")
        found.remove(fits[0])
    require(not found, f"problems nobody expected: {[p[2] for p in found]}")


def main():
    expected = tomllib.loads((FOLDER / "expected.toml").read_text())
    files = {p.stem: p for p in FOLDER.glob("*.toml") if p.name != "expected.toml"}
    require(len(files) >= 50, f"only {len(files)} inputs in {FOLDER}")
    require(files.keys() == expected["files"].keys(),
            f"files and expected.toml differ: {sorted(files.keys() ^ expected['files'].keys())}")
    place = Refusal()

    # The frame around all of this: the scene itself is good, so what is refused below is refused for its mistake.
    good = scratch() / "scene.toml"
    good.write_text(SCENE)
    run(good, "--check", cwd=place.folder)

    for name, path in sorted(files.items()):
        place.check(name, [path], path, expected["files"][name])
    say(f"{len(files)} malformed files: every problem named with line and key, nothing touched")

    inputs = scratch()
    inputs.chmod(0o755)
    made = generated(inputs)
    require(made.keys() == expected["generated"].keys(),
            f"generated inputs and expected.toml differ: {sorted(made.keys() ^ expected['generated'].keys())}")
    for name, path in made.items():
        options = {}
        if name == "forbidden" and os.geteuid() == 0:  # nothing is forbidden to root
            options["user"] = 65534
        try:
            place.check(name, [path], path, expected["generated"][name], **options)
        except PermissionError:
            say("skipped 'forbidden': another user may not run the program here")
    say(f"{len(made)} odd inputs: binary, huge, deep, unreadable")

    for case in expected["command_line"]:
        place.check(str(case["overrides"]), [good, *case["overrides"]], good, case["problems"])
    say(f"{len(expected['command_line'])} malformed overrides")

    # Words that are no input at all.
    for words, wanted in (([], "no input file"), (["--chekc", good], "--chekc"), ([good, "--restart"], "--restart")):
        result = run(*words, code=2, cwd=place.folder)
        require(wanted in result.err, f"'{wanted}' expected: {result}")
        require(snapshot(place.folder) == place.before, f"files were touched by {result}")
    say("no input, an unknown option, an option without its value")

    # --check, --restart and valid keys beside wrong ones do not soften a refusal.
    path = files["98_many_at_once"]
    for words in (["--check"], ["--restart", "out"], ["run.wall_clock_limit_s=1"]):
        place.check(f"{words}", [path, *words], path, expected["files"]["98_many_at_once"])
    say("the same with --check, --restart and a valid override")

    for name in ("01_unknown_key", "79_velocity_of_2d_in_3d", "98_many_at_once"):
        place.check(f"{name} on 2 ranks", [files[name]], files[name], expected["files"][name], ranks=2)
    say("three of them on 2 ranks: said once")
    require(not place.failures, f"{len(place.failures)} cases: {', '.join(place.failures)}")


main()
