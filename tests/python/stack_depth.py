"""The most stack that a bootloader can need, from its linked image: `cargo xtask size` compares it with LEAST_STACK.

For each image: the boot stage, and the RAM image's thread with one of each of its handlers on top of it. That is more than can
happen, as some handlers have the same priority; so it needs no knowledge of priorities and locks. A call through a pointer is one
of the resident part's services, in the thread and below a CAN interrupt: it counts as the deepest of them. In RTIC's own handlers
it is a waker, which makes an interrupt pending. Anything else (a function that calls itself, a frame of unknown size) is an error.

Thumb instructions: ARMv7-M A7.7. Exception frame: B1.5.6, 8 words and one for the alignment; the bootloader has no FPU context.
"""

import bisect
import re
import sys

from capstone import CS_ARCH_ARM, CS_MODE_MCLASS, CS_MODE_THUMB, Cs
from elftools.elf.elffile import ELFFile

FRAME = 36
WAKER = 32
# The callgate's table and the services behind it, in the resident part (shared-abi, `callgate` and `services`).
TABLES = range(0x40, 0xC0, 4)
VECTORS = 0x188
CONDITIONAL = re.compile(r"b(eq|ne|cs|cc|hs|lo|mi|pl|vs|vc|hi|ls|ge|lt|gt|le)(\.w)?$|cbn?z")


class Image:
    def __init__(self, path):
        elf = ELFFile(open(path, "rb"))
        self.segments = [(s["p_vaddr"], s.data()) for s in elf.iter_segments() if s["p_type"] == "PT_LOAD" and s["p_filesz"]]
        symbols = list(elf.get_section_by_name(".symtab").iter_symbols())
        self.symbols = {symbol.name: symbol["st_value"] for symbol in symbols}
        self.names = sorted((s["st_value"] & ~1, s.name) for s in symbols if s["st_info"]["type"] == "STT_FUNC")
        self.decoder = Cs(CS_ARCH_ARM, CS_MODE_THUMB | CS_MODE_MCLASS)
        self.known, self.open, self.services = {}, [], 0

    def read(self, at, size):
        for base, data in self.segments:
            if base <= at < base + len(data):
                return data[at - base : at - base + size]
        raise SystemExit(f"{at:08x}h is no code")

    def words(self, base, offsets):
        return {int.from_bytes(self.read(base + offset, 4), "little") for offset in offsets} - {0}

    def name(self, at):
        index = bisect.bisect(self.names, (at & ~1, "\uffff")) - 1
        return self.names[index][1] if index >= 0 and self.names[index][0] == at & ~1 else f"{at:08x}h"

    def deepest(self, entry):
        """The deepest stack below a function, the calls to there, and whether it returns."""
        entry &= ~1
        if entry in self.known:
            return self.known[entry]
        if entry in self.open:
            raise SystemExit(f"{self.name(entry)} calls itself: its depth has no bound")
        self.open.append(entry)
        best, returns, seen, work = (0, []), False, {}, [(entry, 0)]
        while work:
            at, depth = work.pop()
            masked, tables, conditional = {}, {}, 0
            while seen.get(at, -1) < depth:
                seen[at] = depth
                instruction = next(self.decoder.disasm(self.read(at, 4), at, 1), None)
                if instruction is None:
                    raise SystemExit(f"{at:08x}h: no instruction")
                op, arguments = instruction.mnemonic.removesuffix(".w"), instruction.op_str
                number = int(found[1], 0) if (found := re.search(r"#(-?(?:0x)?[0-9a-f]+)", arguments)) else None
                after, below = at + instruction.size, (0, [])
                conditional -= conditional > 0
                if op.startswith("it"):
                    conditional = len(op)
                elif conditional:
                    work.append((after, depth))
                ends = False
                if op in ("push", "pop", "vpush", "vpop") or op in ("stmdb", "ldm") and arguments.startswith("sp!"):
                    registers = arguments[arguments.index("{") :]
                    size = len(registers.split(",")) * (8 if "{d" in registers else 4)
                    depth += size if op in ("push", "vpush", "stmdb") else -size
                    ends = "pc" in registers
                    returns |= ends
                elif op in ("sub", "subw", "add", "addw") and arguments.startswith("sp,"):
                    if number is None:
                        raise SystemExit(f"{at:08x}h: a stack frame of unknown size: {op} {arguments}")
                    depth += number if op.startswith("sub") else -number
                elif op in ("str", "strd") and "[sp, #-" in arguments and arguments.endswith("!"):
                    depth -= number
                elif op in ("ldr", "ldrd") and "[sp], #" in arguments:
                    depth -= number
                    ends = arguments.startswith("pc")
                    returns |= ends
                elif op == "bfc":
                    masked[arguments.split(",")[0]] = int(arguments.split("#")[2], 0)
                elif op == "mov" and arguments.startswith("sp,"):
                    # A frame that is aligned; or the end of one, before its registers are taken back.
                    depth += (1 << masked.get(arguments.split(", ")[1], 2)) - 4
                elif op == "bl":
                    *below, comes_back = self.deepest(number)
                    ends = not comes_back
                elif op == "blx":
                    below = (self.services, ["through a pointer"])
                elif op in ("adr", "addw") and (op == "adr" or ", pc, " in arguments):
                    tables[arguments.split(",")[0]] = (at + 4 & ~3) + number
                elif op in ("tbb", "tbh"):
                    table = tables.get(arguments[1:].split(",")[0], after)
                    work += ((target, depth) for target in self.targets(table, 1 if op == "tbb" else 2))
                    ends = True
                elif op == "b":
                    after = number
                elif CONDITIONAL.match(instruction.mnemonic):
                    work.append((number, depth))
                elif op in ("bx", "udf"):
                    ends = True
                    returns |= arguments == "lr"
                best = max(best, (depth + below[0], [(entry, depth), *below[1]]), key=lambda path: path[0])
                if ends:
                    break
                at = after
        self.open.pop()
        self.known[entry] = (*best, returns)
        return self.known[entry]

    def targets(self, table, size):
        """A table of TBB or TBH ends at the first of its targets, or with what can be none."""
        found = []
        while True:
            at = table + len(found) * size
            target = table + 2 * int.from_bytes(self.read(at, size), "little")
            if not at < target < table + 4096 or at >= min(found, default=target):
                return found
            found.append(target)


def depths(path):
    image = Image(path)
    resident, size = image.segments[0][0], len(image.segments[0][1])
    tables = image.words(resident, TABLES)
    services = max(image.deepest(word)[0] for word in tables if word & 1 and resident < word < resident + size)
    yield "boot stage", *image.deepest(image.symbols["__resident_reset"])[:2]
    image.services = services
    image.known.clear()
    total, path, _ = image.deepest(image.symbols["Reset"])
    handlers = {}
    for handler in sorted(image.words(image.symbols["__vector_table"], range(8, VECTORS, 4))):
        # Of CAN1 and CAN2, whose handlers are the same code, one is the device's.
        name = image.name(handler).replace("CAN2", "CAN1")
        image.services = services if name.startswith("CAN1") else WAKER
        handlers[name] = image.deepest(handler)
    for depth, more, _ in handlers.values():
        total, path = total + FRAME + depth, path + more
    yield "RAM image", total, path, image


def main():
    sys.setrecursionlimit(10_000)
    failed = False
    for path in sys.argv[1:]:
        image = Image(path)
        least = image.symbols["__least_stack"]
        for what, depth, calls, *_ in depths(path):
            if depth > least:
                failed = True
                print(f"{path}: the {what} needs up to {depth} bytes of stack, and LEAST_STACK (shared-abi/src/layout.rs) is {least}:")
                for call in calls:
                    print(f"  {call if isinstance(call, str) else f'{call[1]:5} {image.name(call[0])}'}")
            else:
                print(f"{path.rsplit('/', 2)[-2]:<23}  {path.rsplit('/', 1)[-1]:<25}  {what:<10}  {depth:>5}  {least:>5}")
    sys.exit(failed)


main()
