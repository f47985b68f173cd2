//! The C header by a second compiler, arm-none-eabi-gcc, which `cargo xtask setup` installs. It is a program of its own:
//! the other tests of the ABI do with what the first jobs of the README install.

mod compiler;

#[test]
fn gcc_compiles_the_header_for_the_chip() {
    compiler::compile_for_the_chip("arm-none-eabi-gcc", "-mthumb");
}
