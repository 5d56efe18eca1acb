#!/usr/bin/env python3
"""Mutation tests: do the quick tests notice that the program is wrong?

    tests/mutants.py                 every mutant of tests/mutants.txt, and which survive
    tests/mutants.py settle ranking  those of these areas
    tests/mutants.py --list          what would be done

All mutants are put into one copy of the sources (target/mutants), each behind a switch that VIEWRANK_MUTANT turns on, so there is one
build of the tests and not one for each (in target/mutants-build). An area names its tests, the quickest first; a mutant is killed if one
of them fails or does not end, and survives if all pass.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COPY = ROOT / "target/mutants"
BUILD = ROOT / "target/mutants-build"
PACKAGES = ["-p=viewrank-core", "-p=viewrank-io", "-p=viewrank"]
SWITCH = """
/// True if this mutant is the one to be tested.
pub(crate) fn mutant(number: u32) -> bool {
    static CHOSEN: std::sync::LazyLock<Option<u32>> =
        std::sync::LazyLock::new(|| std::env::var("VIEWRANK_MUTANT").ok()?.parse().ok());
    *CHOSEN == Some(number)
}
"""


class Mutant:
    def __init__(self, number, area, tests, file, line):
        before, rest = line.split("«")
        change, after = rest.split("»")
        self.old, self.new = (part.strip() for part in re.split(r" ~>(?: |$)", change, maxsplit=1))
        self.number, self.area, self.tests, self.file = number, area, tests, file
        self.around = before.strip(), after.strip()

    def __str__(self):
        return f"{self.number:3} {self.file}: {self.old} ~> {self.new or '(nothing)'}"

    def place(self, text):
        """Where the old code is, as (start, end), however rustfmt breaks its lines."""
        before, old, after = map(pattern, (self.around[0], self.old, self.around[1]))
        found = list(re.finditer(rf"{before}{BETWEEN}({old}){BETWEEN}{after}", text))
        if len(found) != 1:
            sys.exit(f"{self}: {len(found)} such places, not one")
        return found[0].span(1)


# Between two tokens: blanks and comments.
BETWEEN = r"(?:\s|//[^\n]*\n)*"


def pattern(code):
    """A regular expression of the same tokens, with anything BETWEEN them; before a bracket closes, rustfmt adds commas."""
    tokens = re.findall(r"\w+|[^\w\s]", code)
    return BETWEEN.join((rf",?{BETWEEN}" if token in ")]}" else "") + re.escape(token) for token in tokens)


def read_list():
    mutants, area, tests, file = [], None, None, None
    for line in (ROOT / "tests/mutants.txt").read_text().splitlines():
        if found := re.fullmatch(r"# (\w+): (--.*)", line):
            area, tests = found[1], [test.split() for test in found[2].split(";")]
        elif line.startswith("@ "):
            file = line[2:]
        elif "«" in line and not line.startswith("#"):
            mutants.append(Mutant(len(mutants) + 1, area, tests, file, line))
    return mutants


def mutated(text, mutants):
    """The text with every mutant in it, each behind its switch."""
    places = {}
    for mutant in mutants:
        places.setdefault(mutant.place(text), []).append(mutant)
    ends = sorted(places)
    for one, other in zip(ends, ends[1:]):
        if one[1] > other[0]:
            sys.exit(f"{places[one][0]}\n{places[other][0]}\noverlap")
    for (start, end), here in sorted(places.items(), reverse=True):
        code = "".join(f"if crate::mutant({m.number}) {{ {m.new} }} else " for m in here) + f"{{ {text[start:end]} }}"
        text = text[:start] + (code if here[0].old.endswith(";") else f"({code})") + text[end:]
    return text


def prepare(mutants):
    """Copies the sources; files that are as they were keep their times, so that builds are incremental."""
    kept = subprocess.run(["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
    by_file = {}
    for mutant in mutants:
        by_file.setdefault(mutant.file, []).append(mutant)
    names = set(kept.split("\0"))
    for name in names:
        source, copy = ROOT / name, COPY / name
        if not name or not source.is_file():
            continue
        data = source.read_bytes()
        if name in by_file:
            data = mutated(data.decode(), by_file[name]).encode()
        if name in ("src/lib.rs", "crates/core/src/lib.rs", "crates/io/src/lib.rs"):
            data = b"#![allow(warnings)]\n" + data + SWITCH.encode()
        if not copy.is_file() or copy.read_bytes() != data:
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(data)
            shutil.copymode(source, copy)
    for copy in [path for path in COPY.rglob("*") if path.is_file()]:
        if str(copy.relative_to(COPY)) not in names:
            copy.unlink()


def build(targets):
    """Builds the tests; the test programs by target."""
    command = ["cargo", "test", "--no-run", "--quiet", "--locked", "--message-format=json", *PACKAGES, *targets]
    environment = dict(os.environ, CARGO_TARGET_DIR=str(BUILD), CARGO_PROFILE_DEV_DEBUG="0")
    built = subprocess.run(command, cwd=COPY, env=environment, stdout=subprocess.PIPE, text=True)
    if built.returncode:
        for line in built.stdout.splitlines():
            message = json.loads(line).get("message")
            if isinstance(message, dict) and message["level"] == "error":
                print(message["rendered"])
        sys.exit("the mutants do not compile")
    messages = map(json.loads, built.stdout.splitlines())
    return {m["target"]["name"]: m["executable"] for m in messages if m.get("executable") and m["profile"]["test"]}


class Test:
    """A test program and which of its tests are run."""

    def __init__(self, words, programs):
        self.command = [programs[words[1]], *words[2:]]
        self.seconds = 600
        start = time.monotonic()
        if not self.passes(0):
            sys.exit(f"{' '.join(words)}: fails without a mutant")
        self.seconds = 30 + 10 * (time.monotonic() - start)

    def passes(self, number):
        """False if a test fails or does not end."""
        environment = dict(os.environ, VIEWRANK_MUTANT=str(number))
        environment.pop("VIEWRANK_FUZZ_SECONDS", None)
        try:
            return subprocess.run(self.command, cwd=COPY, env=environment, capture_output=True, timeout=self.seconds).returncode == 0
        except subprocess.TimeoutExpired:
            return False


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("areas", nargs="*")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--only", type=int, nargs="+", help="these numbers")
    options = parser.parse_args()
    every = read_list()
    mutants = [m for m in every if (not options.areas or m.area in options.areas) and (not options.only or m.number in options.only)]
    if options.list:
        print(*mutants, sep="\n")
        return
    prepare(every)
    wanted = sorted({tuple(words) for m in mutants for words in m.tests})
    targets = sorted({words[:1] if words[0] == "--lib" else words[:2] for words in wanted})
    programs = build([word for target in targets for word in target])
    tests = {words: Test(words, programs) for words in wanted}
    survivors = []
    for mutant in mutants:
        if all(tests[tuple(words)].passes(mutant.number) for words in mutant.tests):
            survivors.append(mutant)
            print("survives", mutant, flush=True)
    for area in dict.fromkeys(m.area for m in mutants):
        all_of, left = (sum(m.area == area for m in group) for group in (mutants, survivors))
        print(f"{area}: {all_of - left} of {all_of} killed")
    print(f"all: {len(mutants) - len(survivors)} of {len(mutants)} killed, {1 - len(survivors) / len(mutants):.0%}")


if __name__ == "__main__":
    main()
