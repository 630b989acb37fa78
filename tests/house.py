"""The state of the house in numbers: sizes, circles of imports, names that stand for two things.

`python tests/house.py` prints them; `test_architecture.py` holds them.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CORE = ROOT / "crates" / "fingerpost-core" / "src"

PRIVATE_LANGUAGE = (
    r"tells?|told|misled|misleads?|moulds?|moulded|foretold|foretells?|sought|seeks?|sagittas?|"
    r"looks|sights?|votes?|ballots?|steady|skins?|worth|alike|postures?|verdicts?|errands?|"
    r"rehearsals?|witness|witnesses|heard|hear|welcome|aside"
)
"""Words that stood for the field's terms; none is part of the name of anything."""

RETIRED_WORDS = r"tell|told|tells|mould\w*|sagitta\w*|foretold"
"""Those of them that comments do without as well."""

OTHERS_NAMES = {
    "python/fingerpost/recording/session/stream.py": "tell",  # Python's file protocol
    "python/fingerpost/recording/webm.py": r"_SEEK\w*|seeks",  # elements of Matroska
    "tests/test_patterned_table.py": r"SKIN|skin",  # the colour of a hand
}
"""Names with such words that are not the house's own, by file."""


def rust_files() -> dict[str, Path]:
    """Module path below the crate's root of every file of the core, tests apart."""
    files = {}
    for path in sorted(CORE.rglob("*.rs")):
        parts = path.relative_to(CORE).with_suffix("").parts
        if path.stem != "tests":
            files["::".join(parts[:-1] if parts[-1] == "mod" else parts)] = path
    return files


def code_of(source: str) -> str:
    """Rust source without comments, literals and unit tests."""
    source = re.sub(r'"(?:\\.|[^"\\])*"', '""', source)
    return re.sub(r"//[^\n]*", "", source).partition("#[cfg(test)]")[0]


def _paths(tree: str) -> Iterator[list[str]]:
    """Every path of a `use` tree, such as `a::{b, c::{d, e}}`, as its segments."""
    head, brace, rest = tree.partition("{")
    prefix = [part for part in re.split(r"\s*::\s*", head.strip()) if part]
    if not brace:
        yield [part.split(" as ")[0].strip() for part in prefix]
        return
    depth, start, inner = 0, 0, rest[: rest.rindex("}")]
    for k, char in enumerate(inner + ","):
        depth += (char == "{") - (char == "}")
        if char == "," and depth == 0:
            branch = inner[start:k].strip()
            start = k + 1
            if branch:
                yield from ([*prefix, *path] for path in _paths(branch))


def rust_paths(source: str) -> Iterator[list[str]]:
    """Paths that a file names by `use` or from the crate's root, as segments."""
    code = code_of(source)
    for statement in re.findall(r"\buse\s+([^;]+);", code):
        yield from _paths(re.sub(r"\s+", " ", statement))
    for path in re.findall(r"\b(?:crate|super)(?:::\w+)+", re.sub(r"\buse\s+[^;]+;", "", code)):
        yield path.split("::")


def _file_of(path: list[str], module: str, files: Mapping[str, Path]) -> str | None:
    """The file that a path leads into, from the file of `module`; None if out of the crate."""
    here = module.split("::") if module else []
    if path[0] == "crate":
        segments = path[1:]
    elif path[0] in ("super", "self"):
        segments = list(here)
        while path and path[0] in ("super", "self"):
            if path[0] == "super":
                segments = segments[:-1]
            path = path[1:]
        segments += path
    elif "::".join([*here, path[0]]) in files:
        segments = [*here, *path]
    else:
        return None
    for end in range(len(segments), -1, -1):
        name = "::".join(segments[:end])
        if name in files:
            return name
    return None


def handed_on(files: Mapping[str, Path]) -> dict[tuple[str, str], str]:
    """Where a name comes from that a file hands on by `pub use`: (file, name) to file."""
    origin = {}
    for module, path in files.items():
        code = code_of(path.read_text())
        for statement in re.findall(r"\bpub(?:\([a-z]+\))? use\s+([^;]+);", code):
            for segments in _paths(re.sub(r"\s+", " ", statement)):
                source = _file_of(segments, module, files)
                if source is not None:
                    origin[module, segments[-1]] = source
    return origin


def rust_imports(files: Mapping[str, Path]) -> dict[str, set[str]]:
    """The files that each file of the core takes names from, re-exports followed to their source.

    A room's own `mod.rs` is no import of its files when all it does is to hand on their names.
    """
    origin = handed_on(files)
    imports: dict[str, set[str]] = {module: set() for module in files}
    for module, path in files.items():
        source = re.sub(r"\bpub(?:\([a-z]+\))? use\s+[^;]+;", "", path.read_text())
        for segments in rust_paths(source):
            target = _file_of(segments, module, files)
            if target is not None:
                target = origin.get((target, segments[-1]), target)
                imports[module].add(target)
        imports[module].discard(module)
    return imports


def circles(imports: Mapping[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one file (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(imports[node]):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            k = stack.index(node)
            component = stack[k:]
            del stack[k:]
            if len(component) > 1:
                found.append(sorted(component))

    for node in sorted(imports):
        if node not in index:
            visit(node)
    return found


def type_names() -> Counter[str]:
    """How often each name of a type is declared in the core."""
    pattern = r"\b(?:struct|enum|trait|type)\s+([A-Z]\w*)"
    names: Counter[str] = Counter()
    for path in rust_files().values():
        code = re.sub(r"\bimpl\b[^{]*\{", "{", code_of(path.read_text()))
        # Associated types belong to their trait.
        names.update(re.findall(r"(?m)^(?:pub(?:\([a-z]+\))? )?" + pattern, code))
    return names


def sources(*suffixes: str) -> list[Path]:
    """Every file of the project with one of these suffixes, but for this one."""
    rooms = ("python", "crates", "tests", "benches", "docs", "examples")
    found = [path for room in rooms for path in sorted((ROOT / room).rglob("*"))]
    return [path for path in found if path.suffix in suffixes and path != Path(__file__).resolve()]


def declared() -> Iterator[tuple[str, str]]:
    """Every name that is declared, in both languages, with its file."""
    rust = r"\b(?:struct|enum|trait|type|fn|const|static|mod)\s+([A-Za-z_]\w*)"
    for path in sources(".rs"):
        code = re.sub(r'//[^\n]*|"(?:\\.|[^"\\])*"', "", path.read_text())
        yield from ((str(path.relative_to(ROOT)), name) for name in re.findall(rust, code))
    for path in sources(".py", ".pyi"):
        for node in ast.walk(ast.parse(path.read_text())):
            if (name := _name_declared_by(node)) is not None:
                yield str(path.relative_to(ROOT)), name


def _name_declared_by(node: ast.AST) -> str | None:
    match node:
        case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
            return node.name
        case ast.arg():
            return node.arg
        case ast.Name(ctx=ast.Store()):
            return node.id
        case ast.Attribute(ctx=ast.Store()):
            return node.attr
    return None


def function_lengths() -> list[tuple[int, str]]:
    """Lines of every function of the core, signature to closing brace, longest first."""
    lengths = []
    for module, path in rust_files().items():
        lines = path.read_text().partition("#[cfg(test)]")[0].splitlines()
        for k, line in enumerate(lines):
            match = re.match(r"(\s*)(?:pub(?:\([a-z]+\))? )?(?:const )?fn (\w+)", line)
            if match:
                end = next(
                    (j for j in range(k, len(lines)) if lines[j].startswith(match[1] + "}")), k
                )
                if "}" in line and "{" in line:
                    end = k
                lengths.append((end - k + 1, f"{module}::{match[2]}"))
    return sorted(lengths, reverse=True)


def words_of(name: str) -> list[str]:
    """The words of a name in camel or snake case, in lower case."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z0-9]+|[A-Z0-9]+(?![a-z])", name)]


def public_items() -> list[str]:
    """Names that the crate's root hands on."""
    code = code_of((CORE / "lib.rs").read_text())
    items = []
    for statement in re.findall(r"\bpub use\s+([^;]+);", code):
        items += ["::".join(path) for path in _paths(re.sub(r"\s+", " ", statement))]
    return items


def private_names() -> list[tuple[str, str]]:
    """Files and names that still use the private language."""
    private = re.compile(rf"^(?:{PRIVATE_LANGUAGE})$")
    return sorted(
        {
            (where, name)
            for where, name in declared()
            if any(private.match(word) for word in words_of(name))
            and not re.fullmatch(OTHERS_NAMES.get(where, "(?!)"), name)
        }
    )


def retired_words() -> list[tuple[str, int]]:
    """Files with words that are retired, and how often."""
    found = []
    for path in [*sources(".rs", ".py", ".pyi", ".js", ".md"), *ROOT.glob("*.md")]:
        # Python's file protocol has one of them as a method.
        text = re.sub(r"\.tell\(\)|\btell = position\b", "", path.read_text())
        count = len(re.findall(rf"(?i)\b(?:{RETIRED_WORDS})\b", text))
        if count:
            found.append((str(path.relative_to(ROOT)), count))
    return found


def report() -> None:
    """Print every number."""
    files = rust_files()
    lengths = function_lengths()
    middle = sorted(length for length, _ in lengths)[len(lengths) // 2]
    sizes = {name: len(path.read_text().splitlines()) for name, path in files.items()}
    twice = sorted(name for name, count in type_names().items() if count > 1)
    print(f"files of the core: {len(files)}; over 600 lines: ", end="")
    print(sorted(name for name, size in sizes.items() if size > 600))
    print(f"functions: median {middle} lines, longest {lengths[0]}")
    print(f"circles of imports: {circles(rust_imports(files))}")
    print(f"types named twice: {twice}")
    print(f"public items: {len(public_items())}")
    private = private_names()
    print(f"private names: {len(private)}")
    for where, name in private:
        print(f"  {where}: {name}")
    print(f"retired words: {sum(count for _, count in retired_words())}")
    for where, count in retired_words():
        print(f"  {where}: {count}")


if __name__ == "__main__":
    report()
