//! Links the program for its place in the flash of the chosen board.

fn main() {
    let program = if std::env::var_os("CARGO_FEATURE_PROGRAM_2").is_some() { 2 } else { 1 };
    coboot_linker::Application::chosen().program(program).emit();
    // Functions that compile to the same code are one.
    println!("cargo::rustc-link-arg-bins=--icf=all");
}
