//! How much of the stack the bootloader uses: its boot stage, and its RAM image.

use coboot_tests::bench::Bench;
use coboot_tests::{firmware, stack};
use emulator::time::Span;
use shared_abi::geometry::Region;
use shared_abi::layout::LEAST_STACK;

use crate::device::running_board;

/// The boot stage, from power-on to the first instruction of a program and to that of the RAM image,
/// uses no more than is kept free for it: the end of the RAM, where the image is not copied to.
#[test]
fn the_boot_stage_stays_within_its_stack() {
    let board = firmware::board();
    let mut depths = Vec::new();
    for is_installed in [true, false] {
        let mut bench = if is_installed { running_board() } else { Bench::new().switched_on() };
        if is_installed {
            bench.confirm_program();
        }
        bench.power_off();
        bench.power_on();
        let all = Region::new(board.bootloader_ram().end() - 4 * LEAST_STACK, 4 * LEAST_STACK);
        stack::fill(bench.machine(), all);
        let next = if is_installed { board.programs[0] } else { board.ram };
        while !next.contains(bench.machine().pc(), 2) {
            let next = bench.time() + Span::from_micros(1);
            bench.world.run_until(next);
        }
        depths.push(stack::depth(bench.machine(), all));
    }
    println!("bytes of stack, to a program and to the RAM image: {depths:?} of {LEAST_STACK}");
    assert!(depths.iter().all(|depth| (100..=LEAST_STACK).contains(depth)), "{depths:?}");
}

/// An update from the call back to the start of the program.
#[test]
fn an_update_stays_within_the_stack() {
    let mut bench = running_board();
    bench.call_back();
    let stack = stack::of_image(firmware::BOOTLOADER);
    stack::fill(bench.machine(), stack);
    bench.update(firmware::APP_V2);
    let depth = stack::depth(bench.machine(), stack);
    println!("the stack has {} bytes, of which {depth} are used", stack.size);
    assert!((200..=LEAST_STACK).contains(&depth), "{depth} bytes");
}
