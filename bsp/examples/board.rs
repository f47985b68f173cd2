//! Prints the file of the board that `COBOOT_BOARD` names, on the host: its memory map, and the circuit around the chip.
//! `cargo xtask build` writes it beside the images.

use bsp::Pull;
use shared_abi::layout::toml::{Circuit, Toml};

fn main() {
    // A strap without a resistor in the chip has one on the board.
    let pulled_up = bsp::ENTRY_STRAP.filter(|strap| strap.pull == Pull::None && !strap.pressed);
    let circuit = Circuit {
        crystal: bsp::CLOCK_TREE.hse,
        can: bsp::CAN_CONTROLLER,
        usart: bsp::UART,
        pulled_up: pulled_up.map(|strap| (strap.port, strap.pin)),
    };
    print!("{}{circuit}", Toml(bsp::LAYOUT));
}
