//! Thumb programs from assembler text. clang assembles them; its object file comes by a pipe, so no
//! file is written.

use std::collections::BTreeMap;
use std::env;
use std::io::ErrorKind;
use std::path::Path;
use std::process::Command;

use object::elf::R_ARM_ABS32;
use object::{File, Object, ObjectSection, ObjectSymbol, RelocationFlags, RelocationTarget};

/// A program at its place in the memory of the chip.
pub struct Assembled {
    /// Its section `.text`.
    pub code: Vec<u8>,
    /// Its section `.vectors`; empty without one.
    pub vectors: Vec<u8>,
    symbols: BTreeMap<String, u32>,
}

impl Assembled {
    /// The value of a symbol: an address with the Thumb bit if it is a function, or a number.
    pub fn symbol(&self, name: &str) -> Option<u32> {
        self.symbols.get(name).copied()
    }
}

/// Assembles a file of this repository. Its code is for the address that it gives the symbol `BASE`,
/// or for `base`.
pub fn assemble(file: &str, base: u32) -> Assembled {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(file);
    // The variable is that of `cargo xtask build`.
    let mut clang = Command::new(env::var_os("CLANG").unwrap_or_else(|| "clang".into()));
    clang.args(["--target=thumbv7em-none-eabihf", "-c", "-o", "-"]);
    // Files that it includes are beside it.
    let output = clang.arg("-I").arg(path.parent().unwrap()).arg(&path).output();
    let output = output.unwrap_or_else(|error| match error.kind() {
        ErrorKind::NotFound => {
            panic!("clang, which assembles {file}, is missing: `cargo xtask setup` installs it")
        }
        _ => panic!("clang: {error}"),
    });
    assert!(output.status.success(), "{file}: {}", String::from_utf8_lossy(&output.stderr));
    place(&File::parse(&output.stdout[..]).unwrap(), base)
}

/// What a linker does for one section of code: it gives the symbols their addresses, and puts them
/// where the code has room for them.
fn place(file: &File, base: u32) -> Assembled {
    let text = file.section_by_name(".text").unwrap();
    let number = |value: u64| u32::try_from(value).unwrap();
    let base =
        file.symbols().find(|symbol| symbol.name() == Ok("BASE")).map_or(base, |it| number(it.address()));
    let value = |symbol: &object::Symbol| match symbol.section_index() {
        Some(section) if section == text.index() => base + number(symbol.address()),
        _ => number(symbol.address()),
    };
    let placed = |section: &object::Section| {
        let mut bytes = section.data().unwrap().to_vec();
        for (at, relocation) in section.relocations() {
            assert_eq!(relocation.flags(), RelocationFlags::Elf { r_type: R_ARM_ABS32 }, "at {at:#x}");
            let RelocationTarget::Symbol(symbol) = relocation.target() else { panic!("at {at:#x}") };
            let word = &mut bytes[at as usize..][..4];
            let addend = u32::from_le_bytes(word.try_into().unwrap());
            let value = value(&file.symbol_by_index(symbol).unwrap()).wrapping_add(addend);
            word.copy_from_slice(&value.to_le_bytes());
        }
        bytes
    };
    Assembled {
        code: placed(&text),
        vectors: file.section_by_name(".vectors").map_or_else(Vec::new, |section| placed(&section)),
        symbols: file.symbols().map(|symbol| (symbol.name().unwrap().to_owned(), value(&symbol))).collect(),
    }
}
