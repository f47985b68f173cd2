//! The bootloader and an application with CAN over UART on an STM32F405 that others wrote, QEMU's
//! `netduinoplus2`, and on our emulated board: coflash installs, starts, calls back and updates
//! over the serial line, and then both flashes hold the same, sector by sector.
//!
//! `cargo xtask opinion` runs this.

mod access;
mod board;
mod remote;

use std::collections::VecDeque;
use std::io;
use std::time::{Duration, Instant};

use board::Board;
use canopen::program::ProgramControl;
use canopen::{Address, NodeId};
use coboot_can::slcan::{Line, Slcan};
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::firmware;
use coboot_tests::serial::{Serial, SerialLine};
use coflash_core::device::{Session, Timing};
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::Options as Chip;

impl Serial for &mut Board {
    fn time(&self) -> Duration {
        Board::time(self)
    }

    fn take_sent(&mut self, received: &mut VecDeque<u8>) {
        received.append(self.received());
    }

    fn run(&mut self) -> io::Result<()> {
        self.run_for_a_moment()
    }

    fn send(&mut self, bytes: &[u8]) -> usize {
        Board::send(self, bytes);
        bytes.len()
    }
}

/// The application with this many bytes after it, which make another version of it.
fn version(more: usize) -> Program {
    let mut bytes = firmware::raw(firmware::APP_VIRTUAL_CAN);
    bytes.extend((0..more).map(|n| (n * 31 / 8) as u8));
    firmware::blocks_of_raw(&bytes)
}

/// Installs, starts, calls back, updates and calls back again; returns what the device says.
fn update(line: impl Line) -> Vec<String> {
    let mut said = Vec::new();
    let mut adapter = Slcan::open(line, "the line".into(), Some(125_000)).expect("it opens");
    // QEMU shares the host's cores with others.
    let timing = Timing::default().sdo(Duration::from_secs(10));
    let mut session = Session::new(&mut adapter, NodeId::new(NODE).unwrap(), timing);
    for more in [0, 3000] {
        let file = version(more);
        flash(&mut session, &file, &FlashOptions::default().verify(true), &mut |_| {})
            .unwrap_or_else(|error| panic!("{more}: {error}"));
        for (index, sub) in
            [(0x1000, 0), (0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4), (0x1F51, 1), (0x1F56, 1)]
        {
            let value = session.read_number(Address::new(index, sub)).expect("it answers");
            said.push(format!("application {index:04X}h/{sub}: {value:X}h"));
        }
    }
    session.command(1, ProgramControl::StartBootloader).expect("it goes back");
    assert!(session.await_boot_up(Duration::from_secs(1)).unwrap());
    for (index, sub) in [(0x1000, 0), (0x1018, 2), (0x1018, 4), (0x1F51, 1), (0x1F56, 1), (0x1F57, 1)] {
        let value = session.read_number(Address::new(index, sub)).expect("it answers");
        said.push(format!("bootloader {index:04X}h/{sub}: {value:X}h"));
    }
    said
}

#[test]
#[ignore = "needs QEMU: cargo xtask opinion"]
fn an_update_leaves_the_same_flash_on_a_board_of_others() {
    let mut bench = Bench::of_image(firmware::BOOTLOADER_VIRTUAL_CAN);
    let before = bench.machine().flash().to_vec();
    let used = before.iter().rposition(|&byte| byte != 0xFF).expect("a bootloader") + 1;
    bench.power_on();
    bench.run_ms(50);
    let resets = bench.machine().counters().resets;
    let ours = update(SerialLine::new(&mut bench));
    let resets = bench.machine().counters().resets - resets;

    let folder = kit::folder!("second-board");
    let log = folder.join("qemu.log");
    let mut board = Board::power_on(&before[..used], Chip::default().unique_id, &log).expect("QEMU starts");
    let epoch = Instant::now();
    // The boot-up message says that it listens.
    while board.received().is_empty() {
        board.run_for_a_moment().expect("QEMU");
        assert!(board.time() < Duration::from_secs(5), "no boot-up message");
    }
    let theirs = update(SerialLine::new(&mut board));
    let flash = board.flash().expect("QEMU's flash");

    println!(
        "virtual-can on netduinoplus2: {:.1} s of its time in {:.1} s",
        board.time().as_secs_f64(),
        epoch.elapsed().as_secs_f64()
    );
    for (register, count) in &board.stops {
        println!("    {register:08X}h  {count} accesses");
    }
    let mut differ = Vec::new();
    for (n, (address, len)) in board::sectors().into_iter().enumerate() {
        let range = (address - board::FLASH) as usize..(address - board::FLASH + len) as usize;
        let (left, right) = (&bench.machine().flash()[range.clone()], &flash[range]);
        let used = left.iter().filter(|&&byte| byte != 0xFF).count();
        let first = left.iter().zip(right).position(|(a, b)| a != b);
        let same =
            first.map_or("the same".into(), |at| format!("DIFFERS from {:08X}h on", address + at as u32));
        println!("    sector {n:>2}  {used:>6} bytes not erased  {same}");
        if first.is_some() {
            differ.push(n);
        }
    }
    assert_eq!(ours, theirs, "what the device said");
    assert_eq!(resets, u64::from(board.resets), "resets");
    assert!(differ.is_empty(), "sectors {differ:?} differ");
}
