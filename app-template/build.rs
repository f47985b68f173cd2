//! Links the program for its place in the flash of the chosen board.

fn main() {
    coboot_linker::Application::chosen().emit();
    // Functions that compile to the same code are one. Only LLD, the linker of the toolchain, knows
    // it.
    if std::env::var_os("RUSTC_LINKER").is_none() {
        println!("cargo::rustc-link-arg-bins=--icf=all");
    }
}
