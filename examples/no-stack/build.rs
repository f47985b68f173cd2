//! Links the program for its place after the bootloader of the board.

fn main() {
    // Written by `cargo xtask layout --toml --board stm32f407g-disc1 > board.toml`.
    coboot_linker::Application::of_file("board.toml").emit();
}
