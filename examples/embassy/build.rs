//! Links the program for its place after the bootloader of the board.

fn main() {
    coboot_linker::Application::of_board("stm32f407g-disc1").emit();
}
