//! The C header's compilers, which take nothing lightly.

use std::path::{Path, PathBuf};
use std::process::Command;

pub fn include() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/c/coboot")
}

pub fn strict(compiler: &str) -> Command {
    let mut compiler = Command::new(compiler);
    compiler.args(["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wcast-align", "-Werror"]);
    compiler.arg("-I").arg(include());
    compiler
}

pub fn succeed(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| {
        panic!("{command:?}: {error}. `cargo xtask setup` installs the compilers.");
    });
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// What a program for the chip takes from the header and from the library, as C and as C++, as
/// freestanding as it gets: the assertions on sizes and offsets hold there, too.
pub fn compile_for_the_chip(compiler: &str, target: &str) {
    let folder = kit::folder!("header-for-the-chip");
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../abi/for_the_chip.c");
    for language in [["-xc", "-std=c11"], ["-xc", "-std=gnu17"], ["-xc++", "-std=c++17"]] {
        let mut compiler = strict(compiler);
        compiler.arg(target).args(language).args(["-mcpu=cortex-m4", "-ffreestanding", "-Os", "-c"]);
        succeed(compiler.arg(&source).arg("-o").arg(folder.join("chip.o")));
    }
}
