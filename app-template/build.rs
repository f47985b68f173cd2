//! Links the program for its place behind the bootloader of the chosen board.

use std::env;

fn main() {
    let has = |feature: &str| env::var_os(format!("CARGO_FEATURE_{feature}")).is_some();
    let program = if has("PROGRAM_2") { 2 } else { 1 };
    coboot_linker::Application::chosen().program(program).emit();
    // Functions that compile to the same code are one.
    println!("cargo::rustc-link-arg-bins=--icf=all");
}
