//! The C header by a second compiler, arm-none-eabi-gcc, which `cargo xtask setup` installs. It is a program of its own:
//! the other tests of the ABI do with what the first jobs of the README install.

use std::path::Path;
use std::process::Command;

#[test]
fn gcc_compiles_the_header_for_the_chip() {
    let abi = Path::new(env!("CARGO_MANIFEST_DIR")).join("../abi");
    let folder = kit::folder!("header-by-gcc");
    for language in [["-xc", "-std=c11"], ["-xc", "-std=gnu17"], ["-xc++", "-std=c++17"]] {
        let mut gcc = Command::new("arm-none-eabi-gcc");
        gcc.args(["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wcast-align", "-Werror"])
            .args(language);
        gcc.args(["-mthumb", "-mcpu=cortex-m4", "-ffreestanding", "-Os", "-I"])
            .arg(abi.join("../../examples/c/coboot"));
        gcc.arg("-c").arg(abi.join("for_the_chip.c")).arg("-o").arg(folder.join("chip.o"));
        let output = gcc.output().expect("arm-none-eabi-gcc is there");
        assert!(output.status.success(), "{language:?}: {}", String::from_utf8_lossy(&output.stderr));
    }
}
