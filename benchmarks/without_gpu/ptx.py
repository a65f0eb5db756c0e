"""One kernel of PTX as C that runs it on the CPU, block by block: as much of PTX as Numba makes of our kernels.

A thread's registers are a structure; it runs until it is done or waits at a barrier, then the next one does. Within a
block threads take turns in their order, or in the opposite one: where that changes a result, they race. Approximate
instructions are exact here, and what the assembler makes of PTX is not looked at.
"""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path
from typing import Any

FIELDS = {"rd": "u64", "fd": "f64", "r": "u32", "f": "f32", "p": "u8"}  # registers by the letters of their names
SPECIAL = {
    f"%{name}.{axis}": f"{field}[{i}]"
    for name, field in (("tid", "t->at"), ("ctaid", "b->at"), ("ntid", "b->threads"), ("nctaid", "b->blocks"))
    for i, axis in enumerate("xyz")
}
SIGNS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "rem": "%", "and": "&", "or": "|", "xor": "^"}
COMPARED = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
OPPOSITE = {"lt": "ge", "le": "gt", "gt": "le", "ge": "lt", "ne": "eq"}  # of an unordered comparison
ROUNDED = {"rzi": "trunc", "rni": "rint", "rmi": "floor", "rpi": "ceil"}

HEAD = r"""
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
typedef uint8_t u8; typedef uint32_t u32; typedef uint64_t u64; typedef int32_t s32; typedef int64_t s64;
typedef float f32; typedef double f64;
#define AS(to, from) static inline to to##_of_##from(from a) { to b; memcpy(&b, &a, sizeof b); return b; }
AS(f32, u32) AS(u32, f32) AS(f64, u64) AS(u64, f64)
static inline s32 whole_s32(f64 x)
    { return isnan(x) ? 0 : x >= 2147483647. ? INT32_MAX : x <= -2147483648. ? INT32_MIN : (s32)x; }
static inline s64 whole_s64(f64 x)
    { return isnan(x) || x <= -9223372036854775808. ? INT64_MIN : x >= 9223372036854775808. ? INT64_MAX : (s64)x; }
static inline u64 whole_u64(f64 x) { return !(x > 0) ? 0 : x >= 18446744073709551616. ? UINT64_MAX : (u64)x; }
static inline f32 flushed(f32 x) { return fabsf(x) < 1.17549435e-38f ? copysignf(0.f, x) : x; }
"""

RUN = r"""
int run(const u32 *blocks, const u32 *threads, u8 **arguments, int backwards) {
    int diverged = 0;
    u32 n = threads[0] * threads[1] * threads[2];
    Thread *all = malloc(n * sizeof *all);
    Block *b = malloc(sizeof *b);
    memcpy(b->threads, threads, sizeof b->threads);
    memcpy(b->blocks, blocks, sizeof b->blocks);
    for (u64 k = 0; k < (u64)blocks[0] * blocks[1] * blocks[2]; k++) {
        b->at[0] = k % blocks[0], b->at[1] = k / blocks[0] % blocks[1], b->at[2] = k / blocks[0] / blocks[1];
        memset(all, 0xFF, n * sizeof *all), memset(&b->shared, 0xFF, sizeof b->shared); /* what nobody has set */
        for (u32 i = 0; i < n; i++) {
            Thread *t = all + i;
            t->next = t->done = 0;
            t->at[0] = i % threads[0], t->at[1] = i / threads[0] % threads[1], t->at[2] = i / threads[0] / threads[1];
        }
        for (u32 left = n; left;) {
            int barrier = 0; /* at which threads wait: all at the same one */
            for (u32 i = 0; i < n; i++) {
                Thread *t = all + (backwards ? n - 1 - i : i);
                if (t->done) continue;
                if (!go(t, b, arguments)) t->done = 1, left--;
                else if (barrier && barrier != t->next) diverged = 1;
                else barrier = t->next;
            }
        }
    }
    free(all), free(b);
    return diverged;
}
"""


def compiled(ptx: str, folder: Path) -> tuple[str, Any]:
    """The name of the kernel in ``ptx``, and its C function ``run``, built in ``folder``: it tells whether threads of a
    block waited at different barriers. Raises ValueError for an instruction that is not known here."""
    name, source = translated(ptx)
    stem = folder / f"kernel{len(list(folder.glob('kernel*.c')))}"
    stem.with_suffix(".c").write_text(source)
    command = ["gcc", "-O1", "-ffp-contract=off", "-w", "-shared", "-fPIC", "-o", f"{stem}.so", f"{stem}.c", "-lm"]
    subprocess.run(command, check=True)
    return name, ctypes.CDLL(f"{stem}.so").run


def translated(ptx: str) -> tuple[str, str]:
    """The kernel's name, and C."""
    text = re.sub(r"//[^\n]*", "", ptx)
    entry = re.search(r"\.visible \.entry (\w+)\((.*?)\)", text, re.S)
    assert entry is not None
    known, shared, constants = _variables(text)
    known |= {name: f"arguments[{i}]" for i, name in enumerate(re.findall(r"\.param \.\w+ (\w+)", entry[2]))}
    body = _body(text, text.index("{", entry.end()))
    counts = {letters: int(n) for letters, n in re.findall(r"\.reg \.\w+\s+%([a-z]+)<(\d+)>", body)}
    depot = re.search(r"\.local .*?\[(\d+)\]", body)
    registers = "".join(f"{kind} {letters}[{counts.get(letters, 1)}]; " for letters, kind in FIELDS.items())
    barriers = 0
    lines = []
    for statement in _statements(body):
        line = _line(statement, known)
        if "BARRIER" in line:
            barriers += 1
            line = line.replace("BARRIER", f"t->next = {barriers}; return 1; case {barriers}: ;")
        lines.append(line)
    return entry[1], "\n".join(
        [
            HEAD,
            *constants,
            "typedef struct { u32 at[3], threads[3], blocks[3];",
            f"struct {{ u8 none; {' '.join(shared)} }} shared; }} Block;",
            f"typedef struct {{ int next, done; u32 at[3]; u64 SP, SPL; {registers}",
            f"u8 depot[{depot[1] if depot else 8}] __attribute__((aligned(16))); }} Thread;",
            "static int go(Thread *t, Block *b, u8 **arguments) { switch (t->next) { case 0: ;",
            *lines,
            "} return 0; }",
            RUN,
        ]
    )


def _variables(text: str) -> tuple[dict[str, str], list[str], list[str]]:
    """The variables outside the kernel: their C names, and declarations of those of a block and of all others."""
    known, shared, constants = {"__local_depot0": "t->depot"}, [], []
    pattern = r"\.(global|const|shared) \.align \d+ \.(\w+) ([\w$]+)(?:\[(\d+)\])?(?: = \{(.*?)\})?;"
    for space, kind, name, size, values in re.findall(pattern, text):
        c = f"v_{name.replace('$', '_')}"
        declared = f"u8 {c}[{int(size or 1) * (8 if kind.endswith('64') else 1)}] __attribute__((aligned(16)))"
        known[name] = f"b->shared.{c}" if space == "shared" else c
        if space == "shared":
            shared.append(f"{declared};")
        else:
            constants.append(f"static {declared} = {{{values or 0}}};")
    return known, shared, constants


def _body(text: str, start: int) -> str:
    """What stands between the brace at ``start`` and the one that closes it, without the braces in it."""
    depth, end = 1, start + 1
    while depth:
        depth += {"{": 1, "}": -1}.get(text[end], 0)
        end += 1
    body = text[start + 1 : end - 1]
    # Numba's kernels call but one function: it reduces angles beyond 2³⁰, which ours never have
    body = re.sub(r"\{\s*(?:\.reg \.b32 temp_param_reg;)?\s*\.param.*?call\.uni.*?\}", "trap;", body, flags=re.S)
    body = re.sub(r"mov\.b64\s*\{%temp, (%r\d+)\}", r"upper \1", body)
    body = re.sub(r"mov\.b64\s*\{(%r\d+), %temp\}", r"lower \1", body)
    body = re.sub(r"mov\.b64\s*(%fd\d+), \{(%r\d+), (%r\d+)\}", r"both \1, \2, \3", body)
    return re.sub(r";\s*\}", "; ", re.sub(r"(?<=[;\s])\{\s", " ", body))


def _statements(body: str) -> list[str]:
    found = []
    for statement in " ".join(body.split()).split(";"):
        rest = statement.strip()
        while label := re.match(r"\$\w+:", rest):
            found.append(label[0])
            rest = rest[label.end() :].strip()
        if rest and not rest.startswith("."):
            found.append(rest)
    return found


def _line(statement: str, known: dict[str, str]) -> str:
    """C of one statement."""
    if statement.endswith(":"):
        return f"L{statement[1:]} ;"
    guard = ""
    if predicate := re.match(r"@(!?)%p(\d+)\s+", statement):
        guard = f"if ({predicate[1]}t->p[{predicate[2]}]) "
        statement = statement[predicate.end() :]
    operation, _, rest = statement.partition(" ")
    parts = operation.split(".")
    operands = [operand.strip() for operand in re.split(r",(?![^{]*\})", rest)]
    if parts[0] == "bar":
        return "BARRIER"
    simple = {"trap": "abort();", "ret": "return 0;", "bra": f"goto L{operands[0][1:]};"}
    if parts[0] in simple:
        return guard + simple[parts[0]]
    return guard + "{ " + _done(parts, operands, known) + " }"


def _done(parts: list[str], operands: list[str], known: dict[str, str]) -> str:
    """C of an instruction that computes or moves something."""
    base, kind = parts[0], _kind(parts[-1])
    if base == "ld" and "v2" in parts:
        targets, size = operands[0].strip("{}").split(","), int(kind[1:]) // 8
        at = _address(operands[1], known)
        return " ".join(_put(target, f"*({kind} *)({at} + {size * i})", kind) for i, target in enumerate(targets))
    if base == "ld":
        return _put(operands[0], f"*({kind} *)({_address(operands[1], known)})", kind)
    if base == "st":
        return f"*({kind} *)({_address(operands[0], known)}) = {_get(operands[1], kind, known)};"
    if base in ("upper", "lower"):
        bits = f"u64_of_f64({_get(operands[1], 'f64', known)})"
        return _put(operands[0], f"{bits} >> {32 if base == 'upper' else 0}", "u32")
    if base == "both":
        low, high = (_get(operand, "u32", known) for operand in operands[1:])
        return _put(operands[0], f"f64_of_u64({low} | (u64){high} << 32)", "f64")
    if base == "cvt":
        to, origin = _kind(parts[-2]), kind
        return _put(operands[0], _converted(_get(operands[1], origin, known), origin, to, parts), to)
    if base == "selp":
        one, other = (_get(operand, kind, known) for operand in operands[1:3])
        return _put(operands[0], f"{_get(operands[3], 'u8', known)} ? {one} : {other}", kind)
    if base == "setp":
        return _put(operands[0], _compared(parts[1], *(_get(operand, kind, known) for operand in operands[1:])), "u8")
    given = [_get(operand, kind, known) for operand in operands[1:]]
    if base in ("shl", "shr", "bfi"):  # how far, whatever the kind
        given[-1:] = [_get(operands[-1], "u32", known)]
    wide = "wide" in parts
    value = _value(base, kind, given, parts, operands[1:])
    value = f"flushed({value})" if "ftz" in parts and kind == "f32" else value
    return _put(operands[0], value, f"{kind[0]}64" if wide else kind)


def _value(base: str, kind: str, x: list[str], parts: list[str], operands: list[str]) -> str:
    """C of the result of arithmetic on the values ``x``."""
    single, whole, predicate = ("f" if kind == "f32" else ""), kind[0] != "f", parts[-1] == "pred"
    unsigned = f"u{kind[1:]}"
    if base in ("mov", "cvta"):
        return x[0]
    if base == "mul" and "wide" in parts:
        return f"({kind[0]}64){x[0]} * ({kind[0]}64){x[1]}"
    if base in ("add", "sub", "mul") and whole and "hi" not in parts:
        return f"({kind})(({unsigned}){x[0]} {SIGNS[base]} ({unsigned}){x[1]})"
    if base == "mul" and "hi" in parts:
        wider = {"u32": "u64", "s32": "s64", "u64": "unsigned __int128", "s64": "__int128"}[kind]
        return f"(({wider}){x[0]} * ({wider}){x[1]}) >> {kind[1:]}"
    if base in SIGNS:
        return f"{x[0]} {SIGNS[base]} {x[1]}"
    if base == "mad" and "lo" in parts:
        return f"({unsigned}){x[0]} * ({unsigned}){x[1]} + ({unsigned}){x[2]}"
    if base in ("min", "max") and whole:
        return f"{x[0]} {'<' if base == 'min' else '>'} {x[1]} ? {x[0]} : {x[1]}"
    if base in ("min", "max"):
        return f"f{base}{single}({x[0]}, {x[1]})"
    if base in ("shl", "shr"):
        beyond = f"{x[0]} < 0 ? -1 : 0" if kind[0] == "s" else "0"
        return f"{x[1]} >= {kind[1:]} ? ({beyond}) : {x[0]} {'<<' if base == 'shl' else '>>'} {x[1]}"
    if base == "bfi" and all(operand.isdigit() for operand in operands[2:]):
        mask = ((1 << int(operands[3])) - 1) << int(operands[2])
        return f"({x[1]} & ~({kind}){mask}ull) | ({x[0]} << {operands[2]} & {mask}ull)"
    if base == "fma":
        return f"fma{single}({x[0]}, {x[1]}, {x[2]})"
    if base == "not":
        return f"!{x[0]}" if predicate else f"~{x[0]}"
    unary = {"neg": f"-{x[0]}", "abs": f"fabs{single}({x[0]})", "sqrt": f"sqrt{single}({x[0]})", "rcp": f"1 / {x[0]}"}
    if base in unary:
        return unary[base]
    raise ValueError(f"{'.'.join(parts)} {operands}: expected an instruction that is known here")


def _compared(how: str, x: str, y: str) -> str:
    if how in COMPARED:
        return f"{x} {COMPARED[how]} {y}" if how != "ne" else f"{x} < {y} || {x} > {y}"
    if how[:-1] in OPPOSITE and how.endswith("u"):
        return f"!({x} {COMPARED[OPPOSITE[how[:-1]]]} {y})"
    raise ValueError(f"setp.{how}: expected a comparison that is known here")


def _converted(value: str, origin: str, to: str, parts: list[str]) -> str:
    rounding = next((ROUNDED[part] for part in parts if part in ROUNDED), None)
    if origin[0] == "f" and rounding is not None:
        value = f"{rounding}({value})"
    if origin[0] == "f" and to[0] != "f":
        return f"whole_{to}({value})"
    return f"flushed((f32){value})" if "ftz" in parts and to == "f32" else f"({to})({value})"


def _kind(suffix: str) -> str:
    """The C type of a value that PTX calls ``suffix``."""
    return "u8" if suffix == "pred" else suffix.replace("b", "u")


def _register(operand: str) -> tuple[str, str] | None:
    if found := re.fullmatch(r"%(rd|fd|r|f|p)(\d+)", operand):
        return f"t->{found[1]}[{found[2]}]", FIELDS[found[1]]
    return (f"t->{operand[1:]}", "u64") if operand in ("%SP", "%SPL") else None


def _get(operand: str, kind: str, known: dict[str, str]) -> str:
    """C of an operand's value as ``kind``: a register of another kind gives its bits."""
    operand = operand.strip()
    if found := _register(operand):
        name, has = found
        if has == kind or (has[0] != "f" and kind[0] != "f"):
            return f"({kind}){name}"
        return f"{kind}_of_{has}({name})" if kind[0] == "f" else f"({kind}){'u' + has[1:]}_of_{has}({name})"
    if operand[:2] in ("0f", "0d"):
        return f"f32_of_u32(0x{operand[2:]}u)" if operand[1] == "f" else f"f64_of_u64(0x{operand[2:]}ull)"
    if operand in SPECIAL:
        return f"({kind}){SPECIAL[operand]}"
    return f"(u64){known[operand]}" if operand in known else f"({kind})({int(operand, 0) % 2**64}ull)"


def _put(target: str, value: str, kind: str) -> str:
    """C that puts a value of ``kind`` into a register, as bits where that is of another kind."""
    found = _register(target.strip())
    assert found is not None, target
    name, has = found
    if has == kind or (has[0] != "f" and kind[0] != "f"):
        unsigned = f"(u{kind[1:]})" if kind[0] == "s" else ""  # what is wider keeps no sign
        return f"{name} = {unsigned}({value});"
    return f"{name} = {has}_of_{'u' + has[1:]}({value});" if has[0] == "f" else f"{name} = {has}_of_{kind}({value});"


def _address(operand: str, known: dict[str, str]) -> str:
    found = re.fullmatch(r"\[([%\w$]+)(?:\+(-?\d+))?\]", operand)
    assert found is not None, operand
    base = _register(found[1])
    return f"(u8 *){base[0] if base else known[found[1]]} + ({found[2] or 0})"
