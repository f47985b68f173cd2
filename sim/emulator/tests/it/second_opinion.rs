//! Small programs for the CPU (second_opinion/programs.s) on our machine, against the Armv7-M
//! Architecture Reference Manual (DDI 0403E), and on a machine that others wrote: QEMU's mps2-an386.
//!
//! `cargo xtask opinion` runs the second half.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use std::{env, fs, thread};

use crate::assembler::{assemble, Assembled};
use emulator::machine::{Machine, Options};
use emulator::time::Time;
use shared_abi::geometry::STM32F407VG;

const STACK: u32 = 0x2001_0000;
/// Where the programs write.
const RESULTS: u32 = 0x2000_0000;
/// Where they jump at the end.
const END: u32 = 0x2000_3000;
/// Where they are.
const CODE: u32 = 0x2000_4000;
/// Words that are compared; those after the last one of a program are 0.
const WORDS: usize = 64;
/// The last word of every program.
const LAST: u32 = 0x0E0E_0E0E;

/// What is known about a program.
struct Program {
    name: &'static str,
    shows: &'static str,
    /// The words that it writes, by the manual; the last one is left out.
    words: &'static [&'static [u32]],
    /// Words that are the address of a symbol: which, and its name.
    addresses: &'static [(usize, &'static str)],
    /// Words that differ on QEMU: which, what they are there, and why.
    differs: &'static [(usize, u32, &'static str)],
    /// Words in which our machine does not do what the manual says: which, what they are, and why.
    gaps: &'static [(usize, u32, &'static str)],
}

const SFPA: &str = "ours is wrong: bit 3 of CONTROL is reserved in Armv7-M (B1.4.4)";
const EAGER: &str = "ours saves the FPU's registers at once: LSPACT stays 0 (B1.5.7)";
const UNALIGNED: &str =
    "ours lets unaligned LDM, STM, LDRD, STRD, VLDR, VSTR be without UNALIGN_TRP (A3.2.1)";
const STREX: &str = "ours and QEMU look at the monitor before the alignment (B2.3.7)";
const NO_SLEEP: &str = "QEMU ignores SCR.SLEEPONEXIT (B1.5.8)";

/// Bits of CFSR and HFSR.
const U: u32 = 1 << 24;
const STKERR: u32 = 1 << 12;
const FORCED: u32 = 1 << 30;

/// EXC_RETURN, the stack pointer, and the basic frame; the program counter in it is a symbol's address.
const fn frame(sp: u32, xpsr: u32) -> [u32; 10] {
    let [r0, r1, r2, r3, r12, lr] =
        [0xA0A0_A0A0, 0xA1A1_A1A1, 0xA2A2_A2A2, 0xA3A3_A3A3, 0xACAC_ACAC, 0xAEAE_AEAE];
    [0xFFFF_FFF9, sp, r0, r1, r2, r3, r12, lr, 0, xpsr]
}

const fn program(name: &'static str, shows: &'static str, words: &'static [&'static [u32]]) -> Program {
    Program { name, shows, words, addresses: &[], differs: &[], gaps: &[] }
}

const PROGRAMS: &[Program] = &[
    program(
        "order",
        "SysTick, PendSV, SVCall by priority, one after another (B1.5.4)",
        &[&[1, 15, 14, 2, 11, 3]],
    ),
    program(
        "preemption",
        "a higher group priority preempts; the subpriority orders (B1.5.4)",
        &[&[0x10, 0x11, 0x12, 1, 0x10, 0x12, 0x11, 2, 0x10, 0x12, 0x11, 3, 0x11, 0x10, 0x12, 0x11, 4]],
    ),
    program(
        "basepri",
        "BASEPRI masks its priority and below; BASEPRI_MAX only raises (B1.4.3, B5.2.3)",
        &[&[1, 1, 0x10, 2, 0x40, 0x20, 0x20, 0x10, 3]],
    ),
    program(
        "basepri_max",
        "BASEPRI_MAX against masked and unmasked lines (B5.2.3)",
        &[&[0xC0, 0xC0, 0x80, 1, 2, 0x10, 3]],
    ),
    program(
        "reprioritised",
        "a priority that changes while it is pending counts at once (B1.5.4)",
        &[&[0x11, 0x10, 1, 2, 0x11, 3, 0x20, 0x21, 0x11, 0x22, 4]],
    ),
    program(
        "vector_table",
        "VTOR moves the table; the vector is read on entry (B1.5.3, B1.5.6)",
        &[&[14, 0x2000_2400, 0x20, 14, 1]],
    ),
    program(
        "masks",
        "PRIMASK and FAULTMASK; a return clears FAULTMASK (B1.4.3)",
        &[&[1, 0x10, 1, 1, 0x10, 2, 1, 0]],
    ),
    Program {
        addresses: &[(8, "after_first"), (18, "after_second")],
        ..program(
            "frame",
            "the basic frame, also from a stack at 4 bytes (B1.5.6, B1.5.7)",
            &[&frame(0x2000_FFE0, 0x6100_0000), &frame(0x2000_FFD8, 0x6100_0200), &[0x2000_FFFC]],
        )
    },
    Program {
        gaps: &[(1, 0xC, SFPA), (3, 0, EAGER), (9, 0xC, SFPA)],
        ..program(
            "float_frame",
            "the extended frame; LSPACT until the handler uses the FPU (B1.5.7)",
            &[&[0, 4, 0xFFFF_FFE9, 1, 0, 0, 0x2000_FF98, 0x3F80_0000, 0x3F80_0000, 4]],
        )
    },
    program(
        "fpscr",
        "FPSCR survives an exception (B1.5.7)",
        &[&[0xFFFF_FFE9, 0xA3C0_0081, 0x3EAA_AAAA, 0xA3C0_0091]],
    ),
    program(
        "nested_float",
        "S0 and FPSCR in three contexts, one inside the other (B1.5.7)",
        &[&[0xFFFF_FFE9, 0], &[0xFFFF_FFE1, 0], &[0x4000_0000, 2 << 22], &[0x3F80_0000, 3 << 22]],
    ),
    program(
        "process_stack",
        "PSP, MSP and CONTROL; without privilege CPS and MSR are ignored (B1.4.4, B5.2)",
        &[&[2, 0x2000_8000, 0xFFFF_FFFD, 0x2000_7FE0, STACK, 0, 0, 0xFFFF_FFFD, 0x2000_7FE0, STACK, 1, 0]],
    ),
    program("usage_fault", "an undefined instruction (B3.2.15)", &[&[0, 6, 1 << 16, 0]]),
    program(
        "traps",
        "division by zero and an unaligned access, trapped (B3.2.8, B3.2.15)",
        &[&[0, 6, 1 << 25, 0, 0, 6, 1 << 24, 0, 1]],
    ),
    program(
        "traps_in_it",
        "the same in IT blocks, by their conditions; the IT state is stacked (B1.4.2, B1.5.6)",
        &[
            &[0x800, 0, 6, 1 << 25, 0, 5],
            &[0x800, 0, 6, 1 << 25, 0],
            &[3, 7],
            &[0x400, 0, 6, 1 << 24, 0, 7, 0, 1],
        ],
    ),
    Program {
        gaps: &[
            (5, 0, STREX),
            (7, 0, UNALIGNED),
            (8, 0, UNALIGNED),
            (9, 0, UNALIGNED),
            (10, 0, UNALIGNED),
            (11, 0, UNALIGNED),
            (12, 0, UNALIGNED),
        ],
        ..program(
            "alignment",
            "what must be aligned always, and what with UNALIGN_TRP (A3.2.1, B3.2.8)",
            &[
                &[0x5544_3322, 0x3322, 0xA7A8_2211, 0x88A7_A8A6],
                &[U, U, 0, U, U, U, U, U, U],
                &[U, U, 0, U, U, 0, 0, 0, U, U, U, U, U],
                &[0],
            ],
        )
    },
    program(
        "bus_fault",
        "a precise error: BFAR, BFARVALID, PRECISERR (B3.2.15, B3.2.18)",
        &[&[0xA000_0000, 0, 5, 0x8200, 0]],
    ),
    program(
        "escalation",
        "a fault or SVCall that cannot be taken is a HardFault (B1.5.4, B3.2.16)",
        &[&[0, 3, 1 << 16, 1 << 30, 3, 0, 1 << 30, 0x40]],
    ),
    program(
        "stacking",
        "no stack to write to: BusFault or HardFault and the exception, by priority (B1.5.11)",
        &[
            &[5, STKERR, 0, 1 << 15, 11, 0, 0, 0, 1],
            &[5, STKERR, 0, 0, 16, 0, 0, 0, 2],
            &[5, STKERR | 1 << 16, 0, 1 << 12, 6, 0, 0, 0, 3],
            &[11, STKERR, 0, 1 << 14, 5, 0, 0, 0, 4],
            &[3, STKERR, FORCED, 1 << 15, 11, 0, 0, 0, 5],
            &[3, STKERR, FORCED, 1 << 15, 11, 0, 0, 0, 6],
            &[3, STKERR | 1 << 16, FORCED, 0, 7],
        ],
    ),
    program(
        "bit_band",
        "the alias of SRAM: bit 0 of the value counts (B3.1)",
        &[&[8, 1, 0, 0x8000_0008, 0x8000_0000]],
    ),
    program(
        "systick",
        "a write clears the counter, a read COUNTFLAG (B3.3.3 to B3.3.5)",
        &[&[0, 0x1_0005, 5, 9999]],
    ),
    program("wait", "WFI ends for an exception that PRIMASK masks (B1.5.19)", &[&[1, 14, 2]]),
    Program {
        differs: &[(0, 1, NO_SLEEP), (1, 2, NO_SLEEP)],
        ..program("sleep_on_exit", "sleeps again after each handler (B1.5.8)", &[&[3, 0]])
    },
    Program {
        differs: &[(0, 0xFFFF_FFFF, "DDI 0403E B1.5.4 leaves 3 to 8 bits; STM32F4 has 4 (PM0214), QEMU 8")],
        ..program("priority_bits", "the bits of a priority that exist", &[&[0xF0F0_F0F0]])
    },
];

// --- the programs, assembled

struct Image(Assembled);

impl Image {
    fn build() -> Self {
        Self(assemble("sim/emulator/tests/it/second_opinion/programs.s", CODE))
    }

    fn symbol(&self, name: &str) -> u32 {
        self.0.symbol(name).unwrap_or_else(|| panic!("the programs have no symbol {name}"))
    }
}

fn bytes(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

fn words(bytes: &[u8]) -> Vec<u32> {
    bytes.chunks_exact(4).map(|word| u32::from_le_bytes(word.try_into().unwrap())).collect()
}

// --- the machines

fn ours(image: &Image, name: &str) -> Vec<u32> {
    let mut machine = Machine::new(&STM32F407VG, Options::default()).unwrap();
    machine.load_bin(0x0800_0000, &bytes(&[STACK, image.symbol(name) | 1])).unwrap();
    machine.power_on(Time(0));
    machine.write_ram(CODE, &image.0.code).unwrap();
    machine.write_ram(END, &bytes(&[0xE7FD_BF30])).unwrap(); // wfi, for ever
    machine.run_until(Time(100_000_000_000));
    let mut result = [0; 4 * WORDS];
    machine.read_memory(RESULTS, &mut result).unwrap();
    words(&result)
}

fn qemu(image: &Image, name: &str) -> Result<Vec<u32>, String> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let place = |part: &str, address: u32, bytes: &[u8]| {
        let file: PathBuf = folder.join(format!("second_opinion_{part}.bin"));
        fs::write(&file, bytes).unwrap();
        format!("loader,file={},addr={address:#x},force-raw=on", file.display())
    };
    // ldr pc, [pc]
    let end = bytes(&[0xF000_F8DF, image.symbol("semihosted_end") | 1]);
    let mut qemu = Command::new("qemu-system-arm");
    qemu.args(["-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "none"]);
    // Virtual time advances with the instructions, not with the host's clock.
    qemu.args(["-icount", "shift=5", "-semihosting-config", "enable=on,target=native"]);
    qemu.args(["-device", &place("start", 0, &bytes(&[STACK, image.symbol(name) | 1]))]);
    qemu.args(["-device", &place("code", CODE, &image.0.code)]);
    qemu.args(["-device", &place("end", END, &end)]);
    qemu.stdin(Stdio::null()).stdout(Stdio::piped());
    let mut child = qemu.spawn().map_err(|error| format!("qemu-system-arm: {error}"))?;
    // It ends in a fraction of a second; the limit is for a program that does not.
    let limit = Instant::now() + Duration::from_secs(60);
    while child.try_wait().map_err(|error| error.to_string())?.is_none() {
        if Instant::now() > limit {
            let _ = child.kill();
            let _ = child.wait();
            return Err("did not end within a minute".into());
        }
        thread::sleep(Duration::from_millis(5));
    }
    let output = child.wait_with_output().map_err(|error| error.to_string())?.stdout;
    match output.len() {
        len if len == 4 * WORDS => Ok(words(&output)),
        len => Err(format!("{len} bytes of results, not {}", 4 * WORDS)),
    }
}

// --- the comparisons

impl Program {
    /// How many words it writes.
    fn count(&self) -> usize {
        self.words.iter().map(|part| part.len()).sum::<usize>() + 1
    }

    /// The whole block of results, by the manual.
    fn expected(&self, image: &Image) -> Vec<u32> {
        let mut words = self.words.concat();
        for &(n, name) in self.addresses {
            words[n] = image.symbol(name);
        }
        words.push(LAST);
        words.resize(WORDS, 0);
        words
    }
}

/// The words that differ: number, left, right.
fn differences(left: &[u32], right: &[u32]) -> Vec<(usize, u32, u32)> {
    let pairs = left.iter().zip(right).enumerate();
    pairs.filter(|(_, (a, b))| a != b).map(|(n, (&a, &b))| (n, a, b)).collect()
}

#[test]
fn our_machine_does_what_the_manual_says() {
    let image = Image::build();
    let mut wrong = String::new();
    for program in PROGRAMS {
        let mut expected = program.expected(&image);
        for &(n, value, _) in program.gaps {
            expected[n] = value;
        }
        for (n, is, should) in differences(&ours(&image, program.name), &expected) {
            wrong += &format!("{}, word {n}: {is:08X}h, by the manual {should:08X}h\n", program.name);
        }
    }
    assert!(wrong.is_empty(), "\n{wrong}");
}

/// `COBOOT_CPU_EVIDENCE` names a file for the result.
#[test]
#[ignore = "needs QEMU: cargo xtask opinion"]
fn qemu_does_the_same() {
    let image = Image::build();
    let (mut compared, mut explained, mut wrong) = (0, Vec::new(), Vec::new());
    for program in PROGRAMS {
        let name = program.name;
        compared += program.count();
        let theirs = match qemu(&image, name) {
            Ok(theirs) => theirs,
            Err(problem) => {
                println!("{name:<14} FAILED on QEMU: {problem}");
                wrong.push(format!("{{\"program\": \"{name}\", \"problem\": {problem:?}}}"));
                continue;
            }
        };
        let found = differences(&ours(&image, name), &theirs);
        let same = if found.is_empty() { "the same" } else { "DIFFERS" };
        println!("{name:<14} {:>2} words  {same:<8}  {}", program.count(), program.shows);
        // An explanation that is no longer needed is a difference, too.
        for &(n, value, why) in program.differs {
            if !found.iter().any(|&(m, _, theirs)| (m, theirs) == (n, value)) {
                println!("    word {n} should be {value:08X}h on QEMU: {why}");
                wrong.push(format!("{{\"program\": \"{name}\", \"word\": {n}, \"problem\": \"not seen\"}}"));
            }
        }
        for (n, ours, theirs) in found {
            let by_manual = program.expected(&image)[n];
            let differs =
                program.differs.iter().filter(|it| (it.0, it.1) == (n, theirs) && ours == by_manual);
            let gaps = program.gaps.iter().filter(|it| (it.0, it.1) == (n, ours) && theirs == by_manual);
            let why = differs.chain(gaps).next().map(|it| it.2);
            println!("    word {n}: {ours:08X}h, QEMU {theirs:08X}h: {}", why.unwrap_or("NOT EXPLAINED"));
            let line = format!(
                "{{\"program\": \"{name}\", \"word\": {n}, \"ours\": {ours}, \"qemu\": {theirs}, \"why\": {:?}}}",
                why.unwrap_or_default()
            );
            if why.is_some() { &mut explained } else { &mut wrong }.push(line);
        }
    }
    println!(
        "{} programs, {compared} words; {} differences explained, {} not",
        PROGRAMS.len(),
        explained.len(),
        wrong.len()
    );
    if let Some(file) = env::var_os("COBOOT_CPU_EVIDENCE") {
        let json = format!(
            "{{\n\"failed\": {},\n\"machine\": \"mps2-an386\",\n\"programs\": {},\n\"words\": {compared},\n\
             \"explained\": [{}],\n\"unexplained\": [{}]\n}}\n",
            wrong.len(),
            PROGRAMS.len(),
            explained.join(", "),
            wrong.join(", ")
        );
        fs::write(file, json).unwrap();
    }
    assert!(wrong.is_empty(), "{} differences without an explanation", wrong.len());
}
