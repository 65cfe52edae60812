"""Functions of the source code that call a parser of bytes or text, found in the syntax trees."""

from __future__ import annotations

import ast
import functools
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ROOTS = ("core", "manager", "worker", "trainer", "factory", "bench")
PARSERS = {
    "parse_json", "load", "loads", "load_scene", "raw_decode", "literal_eval", "fromstring", "parse", "fromhex",
    "frombuffer", "unpack", "unpack_from", "decompress", "decompressobj", "convert", "validate_json", "validate_python",
    "validate_strings", "model_validate", "model_validate_json", "FromString", "MergeFromString", "ParseFromString",
    "load_pem_x509_certificate", "PEM_cert_to_DER_cert", "ZipFile", "reader", "DictReader", "from_pretrained",
    "load_peft_weights",
}  # fmt: skip
"""Names of the parsers that the libraries of this project have: of JSON, TOML, XML, protobuf, zlib, arrays and models."""
MODULES = {
    "load": {"json", "tomllib", "pickle", "torch", "np", "marshal", "yaml", "csv"},
    "loads": {"json", "tomllib", "pickle", "marshal"},
    "parse": {"ET", "ElementTree"},
    "fromstring": {"ET", "ElementTree"},
    "decompress": {"gzip", "zlib", "bz2", "lzma"},
    "convert": {"msgspec"},
    "reader": {"csv"},
}
"""Modules whose functions of these names parse; other objects have methods of the same names."""


class _Finder(ast.NodeVisitor):
    def __init__(self, module: str) -> None:
        self._scope = [module]
        self.found: set[str] = set()

    def visit(self, node: ast.AST) -> None:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            self._scope.append(node.name)
            self.generic_visit(node)
            self._scope.pop()
        else:
            super().visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        owner = ast.unparse(function.value).rpartition(".")[2] if isinstance(function, ast.Attribute) else ""
        decodes_json = name == "decode" and owner == "json"
        if decodes_json or (name in PARSERS and owner in MODULES.get(name, {owner})):
            module, *functions = self._scope
            self.found.add(f"{module}:{'.'.join(functions)}")
        self.generic_visit(node)


@functools.cache
def parsing_functions() -> frozenset[str]:
    """Return every function with such a call, as ``module:qualified name``, without the package's own name."""
    found: set[str] = set()
    for path in sorted(file for root in ROOTS for file in (ROOT / root).rglob("*.py")):
        relative = path.relative_to(ROOT).with_suffix("").parts
        if "embomatrix" in relative:
            finder = _Finder(".".join(relative[relative.index("embomatrix") + 1 :]))
            finder.visit(ast.parse(path.read_text(encoding="utf-8")))
            found |= finder.found
    return frozenset(found)
