//! What the option bytes RDP, SPRMOD and BFB2 do.

use emulator::machine::{Machine, Options, Stop};
use emulator::time::Time;
use shared_abi::geometry::{Geometry, STM32F407VG, STM32F429ZI};

use super::programs::{self, Program};
use super::{load, put, table, word, words, ARGUMENT, MS, OUT};

const BANK_2: u32 = 0x0810_0000;
const MEMRMP: u32 = 0x4001_3800;

fn chip(chip: &'static Geometry, program: &Program) -> Machine {
    let mut machine = Machine::new(chip, Options::default()).unwrap();
    load(&mut machine, program);
    machine
}

fn run_ms(machine: &mut Machine, time: u64) -> Stop {
    let until = Time(machine.now().0 + time * MS);
    machine.run_until(until)
}

/// RM0090 section 3.7.5: with SPRMOD a one of nWRP keeps the data bus out of the sector, a load sets RDERR, and
/// code runs from it. The STM32F407 has no SPRMOD; there the bit is reserved.
#[test]
fn a_hidden_sector_runs_and_does_not_read() {
    const SECTOR_1: u32 = 0x8002_AAEC;
    const CODE: u32 = 0x4770_2007; // movs r0, #7; bx lr
    let run = |geometry, optcr| {
        let mut machine = chip(geometry, &programs::TO_RAM);
        machine.load_bin(0x0800_4000, &CODE.to_le_bytes()).unwrap();
        machine.set_option_bytes(optcr);
        machine.power_on(Time(0));
        let program = &programs::LOADS_HIDDEN_CODE;
        machine.write_ram(program.base, &program.code).unwrap();
        put(&mut machine, ARGUMENT, 0);
        put(&mut machine, 0x2000_0200, 1);
        run_ms(&mut machine, 1);
        words(&machine, 6)
    };
    assert_eq!(run(&STM32F429ZI, SECTOR_1), [0, 0x100, 0, 7, 0, 0x100]);
    assert_eq!(run(&STM32F429ZI, SECTOR_1 & !0x0002_0000), [CODE, 0, 0, 7, CODE, 0], "no sector");
    assert_eq!(run(&STM32F407VG, SECTOR_1), [CODE, 0, 0, 7, CODE, 0]);
}

/// RM0090 section 2.4 and AN2606, dual bank boot: BFB2 boots from the system memory, whose loader starts the second
/// bank if its first word is an address in SRAM, at the start of the flash; if not, the first one.
#[test]
fn with_bfb2_the_second_bank_starts_if_it_has_a_program() {
    const BFB2: u32 = 0x0FFF_AAFC;
    let run = |optcr, second: bool| {
        let mut machine = chip(&STM32F429ZI, &programs::STORES_AND_SLEEPS);
        if second {
            let program = &programs::WRITES_ITS_OWN_CODE;
            machine.load_bin(BANK_2, &table(program)).unwrap();
            machine.load_bin(program.base + 0x0010_0000, &program.code).unwrap();
        }
        machine.set_option_bytes(optcr);
        machine.power_on(Time(0));
        put(&mut machine, OUT, 0);
        assert_eq!(run_ms(&mut machine, 50), Stop::Deadline);
        (word(&machine, OUT), machine.register(MEMRMP).unwrap())
    };
    assert_eq!(run(BFB2, false), (42, 0x001));
    assert_eq!(run(BFB2, true), (1, 0x101));
    assert_eq!(run(BFB2 & !0x10, true), (42, 0x000));

    // The loader stays at address 0: a program that does not set VTOR has its vectors there (of an STM32F429 in
    // ST's forum, "Is BFB2 broken in STM32F429BIT6 bootloader?").
    let mut machine = chip(&STM32F429ZI, &programs::SYSTICK);
    machine.set_option_bytes(BFB2);
    machine.power_on(Time(0));
    assert_eq!(run_ms(&mut machine, 5), Stop::Lockup);

    // Without a program ST's loader waits for a host, and is not here.
    let mut machine = Machine::new(&STM32F429ZI, Options::default()).unwrap();
    machine.set_option_bytes(BFB2);
    machine.power_on(Time(0));
    assert_eq!(run_ms(&mut machine, 1), Stop::Lockup);
    // STM32F42x with 1 MiB in one bank, and STM32F407: the bit is reserved.
    let mut machine = chip(&STM32F407VG, &programs::STORES_AND_SLEEPS);
    machine.set_option_bytes(BFB2);
    machine.power_on(Time(0));
    run_ms(&mut machine, 50);
    assert_eq!((word(&machine, OUT), machine.register(MEMRMP)), (42, Some(0)));
}

/// RM0090 section 3.7.3: with level 1 a debugger that connects shuts the flash until a power-on, and a program that
/// runs from it dies; with level 2 none can connect, and the program does not notice.
#[test]
fn a_debugger_shuts_a_flash_with_read_out_protection() {
    let mut machine = chip(&STM32F407VG, &programs::SYSTICK);
    machine.set_read_protection(0x55);
    machine.power_on(Time(0));
    run_ms(&mut machine, 10);
    assert!(machine.attach_debugger());
    assert!(machine.denies_debugger(0x0800_0000) && machine.denies_debugger(0));
    assert!(!machine.denies_debugger(0x2000_0000));
    machine.detach_debugger();
    machine.resume(false);
    assert_eq!(run_ms(&mut machine, 10), Stop::Lockup);
    machine.reset_pin();
    run_ms(&mut machine, 0);
    assert_eq!(run_ms(&mut machine, 10), Stop::Lockup, "a reset does not open it");
    machine.power_off();
    let now = machine.now();
    machine.power_on(now);
    assert!(!machine.denies_debugger(0x0800_0000));
    assert_eq!(run_ms(&mut machine, 10), Stop::Deadline);

    machine.set_read_protection(0xCC);
    let before = word(&machine, OUT);
    assert!(!machine.attach_debugger());
    assert_eq!((run_ms(&mut machine, 10), machine.halted()), (Stop::Deadline, None));
    assert!(word(&machine, OUT) >= before + 9);

    machine.set_read_protection(0xAA);
    assert!(machine.attach_debugger() && !machine.denies_debugger(0x0800_0000));
}

/// The hardware page's lines for each tool, and what they make of the option bytes of a chip from the factory (RM0090
/// section 3.9.10). Those of probe-rs are played: they write registers (section 3.6.2). `BOR_LEV` and `nWRPn` are ST's
/// names; OpenOCD's `options_write` takes bits 7 to 0 of FLASH_OPTCR, and `flash protect` clears nWRP (its manual).
#[test]
fn the_lines_of_the_hardware_page_set_level_2_and_protect_sector_0() {
    const FACTORY: u32 = 0x0FFF_AAED;
    const OPTCR: u32 = 0x4002_3C14;
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/hardware-checklist.md");
    let page = std::fs::read_to_string(page).unwrap();
    let lines = |start: &'static str| page.lines().filter(move |line| line.starts_with(start));
    let number = |text: &str| match text.strip_prefix("0x") {
        Some(digits) => u32::from_str_radix(digits, 16).unwrap(),
        None => text.parse().unwrap(),
    };
    let played = |last_byte: Option<[u32; 2]>| {
        let mut machine = chip(&STM32F407VG, &programs::STORES_AND_SLEEPS);
        machine.power_on(Time(0));
        run_ms(&mut machine, 1);
        assert_eq!(machine.register(OPTCR), Some(FACTORY));
        let writes: Vec<_> = lines("probe-rs write --chip STM32F407VG b32 ").collect();
        assert_eq!(writes.len(), 4);
        let mut values = last_byte.into_iter().flatten();
        for line in writes {
            let words: Vec<_> = line.split_whitespace().skip(5).map(number).collect();
            let [address, value] = words[..] else { panic!("{line}") };
            let other = if address == OPTCR { values.next() } else { None };
            let value = other.map_or(value, |byte| value & !0xFF | byte);
            machine.poke(address, &value.to_le_bytes()).unwrap();
            run_ms(&mut machine, 1_000);
        }
        machine.power_off();
        machine.power_on(machine.now());
        run_ms(&mut machine, 1);
        machine.register(OPTCR).unwrap()
    };
    // Level 2 is 01b.
    let (level, sector_0) = (0b1100, 1 << 16);
    let wanted = FACTORY & !level & !sector_0 | 0b0100;
    assert_eq!(played(None), wanted, "probe-rs");

    let [st] = lines("STM32_Programmer_CLI -c port=SWD ").collect::<Vec<_>>()[..] else { panic!() };
    let (_, options) = st.split_once(" -ob ").unwrap();
    let set = |optcr: u32, option: &str| {
        let (name, value) = option.split_once('=').unwrap();
        let (bit, width) = match name.strip_prefix("nWRP") {
            Some(sector) => (16 + number(sector), 1),
            None => (2, if name == "BOR_LEV" { 2 } else { panic!("{name}") }),
        };
        optcr & !(((1 << width) - 1) << bit) | number(value) << bit
    };
    assert_eq!(options.split(' ').fold(FACTORY, set), wanted, "{st}");

    let [openocd] = lines("openocd -f board/").collect::<Vec<_>>()[..] else { panic!() };
    let mut optcr = FACTORY;
    for command in openocd.split(['"', ';']).map(|command| command.split_whitespace().collect::<Vec<_>>()) {
        match command[..] {
            ["stm32f2x", "options_write", "0", bits] => optcr = optcr & !0xFC | number(bits) & 0xFC,
            ["flash", "protect", "0", first, last, "on"] => {
                (number(first)..=number(last)).for_each(|sector| optcr &= !(1 << (16 + sector)));
            }
            _ => {}
        }
    }
    assert_eq!(optcr, wanted, "{openocd}");

    // The table: level, supply, BOR_LEV, and the three tools.
    for (row, bor_lev) in [("| 3 |", 0b00), ("| 2 |", 0b01), ("| 1 |", 0b10)] {
        let cells: Vec<_> =
            lines(row).next_back().unwrap().split('|').map(|cell| cell.trim().trim_matches('`')).collect();
        let [_, _, _, bits, st, openocd, probe, _] = cells[..] else { panic!("{cells:?}") };
        assert_eq!(bits, format!("{bor_lev:02b}b"));
        let wanted = wanted & !level | bor_lev << 2;
        assert_eq!(set(FACTORY & !sector_0, st), wanted, "{st}");
        assert_eq!(number(openocd), wanted & 0xFC, "{openocd}");
        let bytes: Vec<_> = probe.split(", ").map(|byte| u32::from_str_radix(byte, 16).unwrap()).collect();
        assert_eq!(played(Some([bytes[0], bytes[1]])), wanted, "{probe}");
    }
}
