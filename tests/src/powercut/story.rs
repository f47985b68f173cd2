//! What happens to a board while its power is cut, and what may be found afterwards.

use std::sync::Arc;

use canopen::program::ProgramControl;
use canopen::{BitRate, NodeId};
use coflash_core::device::Dialect;
use coflash_core::file::sealed::{SealedFile, Sealer};
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions, Payload};
use emulator::bus::fault::{Fault, FaultAction, FrameMatch, When};
use emulator::machine::{Cells, Machine, Options};

use crate::bench::{Bench, NODE, RESCUE_WINDOW_MS};
use crate::{factory, firmware, renewal, sealed_board};

/// A board with a program, confirmed or not, runs it within this time, in ms.
pub const BOOT_MS: u64 = RESCUE_WINDOW_MS + 250;

/// The flash from the start of the first program on.
#[must_use]
pub fn program_flash(flash: &[u8]) -> &[u8] {
    &flash[firmware::program_offset()..]
}

/// The highest bit rate. It is stored in the device and differs from the default, so a device that
/// answers has kept its parameters.
const RATE: BitRate = BitRate::K1000;
/// The same in bit/s.
pub const BIT_RATE: u32 = 1_000_000;
/// The node-ID that a scenario stores.
const OTHER_NODE: u8 = 9;

/// The scenario of a device whose bootloader is renewed; not every board has room for that.
const RENEWAL: &str = "renewal";

/// The program that answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// None: the bootloader does.
    Bootloader,
    /// Version 1.
    Old,
    /// Version 2.
    New,
}

impl Outcome {
    /// Its name in reports.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bootloader => "bootloader",
            Self::Old => "old program",
            Self::New => "new program",
        }
    }
}

/// What answers, and under which node-ID.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observation {
    /// What answers.
    pub outcome: Outcome,
    /// The node-ID.
    pub node: u8,
    /// The version of the bootloader, if the scenario renews it: the program is called back for that.
    pub bootloader: Option<u32>,
}

/// What the host does; it does it again after a cut.
pub type Act = Box<dyn Fn(&mut Bench) -> Result<(), String> + Send + Sync>;

/// The common data of all points of a scenario.
pub struct Story {
    /// The bootloader's image.
    pub bootloader: &'static str,
    /// The flash of the board before.
    pub start: Cells,
    /// What the board does before.
    pub from: Observation,
    /// What it does afterwards.
    pub to: Observation,
    /// What may answer after a cut besides.
    pub between: &'static [Outcome],
    /// Version 1 and version 2 as they lie in the program's flash.
    pub programs: [Vec<u8>; 2],
    /// What the host does.
    pub act: Act,
}

impl Story {
    /// A board of this story without power, and a host at its bit rate.
    #[must_use]
    pub fn bench(&self) -> Bench {
        let mut bench = Bench::of_image(self.bootloader);
        bench.set_host_bit_rate(BIT_RATE);
        bench
    }
}

/// A scenario.
pub struct Scenario {
    /// Its name in points.
    pub name: &'static str,
    /// What happens, in words.
    pub about: &'static str,
    /// Whether the device is sealed. A look then takes ten times as long: such a device computes with
    /// its keys at each start.
    pub is_sealed: bool,
    prepare: fn() -> Result<Story, String>,
}

impl Scenario {
    /// A board that is ready for it.
    ///
    /// # Errors
    /// If this fails without a cut.
    pub fn story(&self) -> Result<Story, String> {
        (self.prepare)()
    }
}

/// The scenarios of the tested board.
pub fn scenarios() -> impl Iterator<Item = &'static Scenario> {
    let board = firmware::board();
    // The compact map has no sealed images, and Intel HEX in ESAcademy's profile alone.
    let (is_split, renews) = (board.home.is_some(), board.staging.is_some());
    let fits = move |scenario: &&Scenario| is_split || !scenario.is_sealed && scenario.name != "hex";
    SCENARIOS.iter().filter(fits).filter(move |scenario| renews || scenario.name != RENEWAL)
}

/// All of them.
pub(super) const SCENARIOS: &[Scenario] = &[
    Scenario {
        name: "update",
        about: "version 2 in blocks, while version 1 runs",
        is_sealed: false,
        prepare: || update(|bench| write(bench, &options())),
    },
    Scenario {
        name: "raw",
        about: "the same in one download of a binary image",
        is_sealed: false,
        prepare: || update(|bench| write(bench, &options().dialect(Some(Dialect::Raw)))),
    },
    Scenario {
        name: "hex",
        about: "the same in one download of Intel HEX",
        is_sealed: false,
        prepare: || update(|bench| write(bench, &options().dialect(Some(Dialect::Hex)))),
    },
    Scenario {
        name: "group",
        about: "the same in blocks of 4 KiB, as a group of devices gets them",
        is_sealed: false,
        prepare: || update(|bench| write_file(bench, &firmware::large_blocks(firmware::APP_V2), &options())),
    },
    Scenario {
        name: "resume",
        about: "the same in blocks, after half of them have arrived",
        is_sealed: false,
        prepare: resume,
    },
    Scenario {
        name: "factory",
        about: "version 2 in blocks is the first update after version 1 of the production line",
        is_sealed: false,
        prepare: factory,
    },
    Scenario {
        name: "confirm",
        about: "version 2 runs and was never confirmed; it is called back, and started again",
        is_sealed: false,
        prepare: confirm,
    },
    Scenario {
        name: "store",
        about: "another node-ID is stored by layer setting services, while version 1 runs",
        is_sealed: false,
        prepare: store,
    },
    Scenario {
        name: RENEWAL,
        about: "the bootloader is renewed, while version 1 runs before and afterwards",
        is_sealed: false,
        prepare: renew_bootloader,
    },
    Scenario {
        name: "sealed",
        about: "version 2 as a sealed image with a higher security counter, while version 1 runs",
        is_sealed: true,
        prepare: || sealed(false),
    },
    Scenario { name: "compressed", about: "the same, compressed", is_sealed: true, prepare: || sealed(true) },
    Scenario {
        name: "counter",
        about: "version 2 once more, with a certificate of a higher epoch, while it runs",
        is_sealed: true,
        prepare: counter,
    },
];

fn options() -> FlashOptions {
    FlashOptions::default().trial_run(false)
}

fn write(bench: &mut Bench, options: &FlashOptions) -> Result<(), String> {
    write_file(bench, &firmware::blocks(firmware::APP_V2), options)
}

fn write_file(bench: &mut Bench, file: &Program, options: &FlashOptions) -> Result<(), String> {
    match flash(&mut bench.session(), file, options, &mut |_| {}) {
        Ok(_) => Ok(()),
        Err(error) => Err(error.to_string()),
    }
}

/// A board with its node-ID and bit rate stored, and this program in it.
fn board(bootloader: &'static str, program: &Payload) -> Result<Bench, String> {
    let mut bench = Bench::of_image(bootloader);
    let board = bench.boards()[0];
    bench.commission(board, NODE, RATE);
    bench.set_host_bit_rate(BIT_RATE);
    if bootloader == firmware::BOOTLOADER_SEALED {
        sealed_board::provision(&mut bench);
    }
    bench.power_on();
    bench.run_ms(BOOT_MS);
    let installed = flash(&mut bench.session(), program, &FlashOptions::default(), &mut |_| {});
    installed.map_err(|error| error.to_string())?;
    Ok(bench)
}

/// The story of a board that runs version 1.
fn from_version_1(
    bootloader: &'static str,
    program: &Payload,
    act: impl Fn(&mut Bench) -> Result<(), String> + Send + Sync + 'static,
) -> Result<Story, String> {
    let mut bench = board(bootloader, program)?;
    bench.power_off();
    Ok(Story {
        bootloader,
        start: bench.machine().flash_cells(),
        from: Observation { outcome: Outcome::Old, node: NODE, bootloader: None },
        to: Observation { outcome: Outcome::New, node: NODE, bootloader: None },
        between: &[Outcome::Bootloader],
        programs: [program_of(firmware::APP_V1)?, program_of(firmware::APP_V2)?],
        act: Box::new(act),
    })
}

fn update(act: impl Fn(&mut Bench) -> Result<(), String> + Send + Sync + 'static) -> Result<Story, String> {
    let version_1 = Arc::new(firmware::blocks(firmware::APP_V1));
    from_version_1(firmware::BOOTLOADER, &version_1.into(), act)
}

/// The board of a story, which runs.
fn running(story: &Story) -> Bench {
    let mut bench = story.bench();
    bench.machine().set_flash_cells(&story.start);
    bench.power_on();
    bench.run_ms(BOOT_MS);
    bench
}

fn resume() -> Result<Story, String> {
    let mut story = update(|bench| write(bench, &options()))?;
    let mut bench = running(&story);
    let before = bench.records().len();
    write(&mut bench, &options())?;
    let half = (bench.records().len() - before) as u64 / 2;

    let mut bench = running(&story);
    let (frames, when) = (FrameMatch::default(), When::FromNth(half));
    bench.world.inject(Fault { frames, when, action: FaultAction::Drop });
    if write(&mut bench, &options()).is_ok() {
        return Err("an update whose frames are lost is done".into());
    }
    bench.power_off();
    story.start = bench.machine().flash_cells();
    story.from.outcome = Outcome::Bootloader;
    Ok(story)
}

/// Version 1 has never been confirmed, and the journal has the records of the production line alone.
fn factory() -> Result<Story, String> {
    let boot = factory::bootloader(firmware::BOOTLOADER);
    let id = NodeId::new(NODE).ok_or("no node-ID")?;
    let boot = boot.with_node(id.get(), RATE as u8).map_err(|fault| fault.to_string())?;
    let mut bench = factory::board(&boot.join(&factory::first(&boot, firmware::APP_V1)));
    let start = bench.machine().flash_cells();
    Ok(Story { start, ..update(|bench| write(bench, &options()))? })
}

fn confirm() -> Result<Story, String> {
    let mut story = update(|bench| {
        let running = bench.session().find().map_err(|error| error.to_string())?;
        if !running.is_bootloader() {
            control(bench, ProgramControl::StartBootloader)?;
        }
        control(bench, ProgramControl::Start)
    })?;
    let mut bench = running(&story);
    write(&mut bench, &options())?;
    bench.power_off();
    story.start = bench.machine().flash_cells();
    story.from.outcome = Outcome::New;
    story.between = &[];
    Ok(story)
}

/// Sends a command after which the device boots.
fn control(bench: &mut Bench, command: ProgramControl) -> Result<(), String> {
    bench.session().command(1, command).map_err(|error| error.to_string())?;
    bench.run_ms(BOOT_MS);
    Ok(())
}

fn store() -> Result<Story, String> {
    let mut story = update(|_| Ok(()))?;
    story.to = Observation { node: OTHER_NODE, ..story.from };
    story.between = &[];
    story.act = Box::new(|bench| {
        // Switch state global: configuration. Configure node-ID. Store (CiA 305). Then a reset.
        bench.post(0x7E5, &[0x04, 1, 0, 0, 0, 0, 0, 0]);
        for [command, a] in [[0x11, OTHER_NODE], [0x17, 0]] {
            let answer = bench.ask(0x7E5, &[command, a, 0, 0, 0, 0, 0, 0], 0x7E4);
            if answer.as_deref() != Some(&[command, 0, 0, 0, 0, 0, 0, 0][..]) {
                return Err(format!("layer setting services answer {answer:02X?} to {command:02X}h"));
            }
        }
        Ok(())
    });
    Ok(story)
}

/// The program is the same before and afterwards, and no cut keeps it from starting.
fn renew_bootloader() -> Result<Story, String> {
    const OLD: u32 = 1;
    const NEW: u32 = 0x0009_0001;
    let new = renewal::plain(&renewal::version(firmware::BOOTLOADER, NEW));
    let mut story = update(move |bench| {
        let renewed = flash(&mut bench.session(), &new, &FlashOptions::default(), &mut |_| {});
        renewed.map(drop).map_err(|error| error.to_string())
    })?;
    story.from.bootloader = Some(OLD);
    story.to = Observation { bootloader: Some(NEW), ..story.from };
    story.between = &[];
    Ok(story)
}

/// An application as a sealed image with this security counter.
fn seal(image: &str, compress: bool, counter: u32) -> Result<Payload, String> {
    seal_with(Sealer { compress, ..sealed_board::sealer(counter) }, image)
}

fn seal_with(sealer: Sealer<'_>, image: &str) -> Result<Payload, String> {
    let bytes =
        sealer.seal(&firmware::raw(image), &sealed_board::release()).map_err(|error| error.to_string())?;
    let file = SealedFile::parse(bytes).map_err(|error| error.to_string())?;
    Ok(Payload::Sealed(Arc::new(file)))
}

fn write_sealed(bench: &mut Bench, program: &Payload) -> Result<(), String> {
    flash(&mut bench.session(), program, &options(), &mut |_| {}).map(drop).map_err(|error| error.to_string())
}

fn sealed(compress: bool) -> Result<Story, String> {
    let version_2 = seal(firmware::APP_V2, compress, sealed_board::COUNTER + 1)?;
    let version_1 = seal(firmware::APP_V1, compress, sealed_board::COUNTER)?;
    from_version_1(firmware::BOOTLOADER_SEALED, &version_1, move |bench| write_sealed(bench, &version_2))
}

fn counter() -> Result<Story, String> {
    let mut story = sealed(false)?;
    let mut bench = running(&story);
    (story.act)(&mut bench)?;
    bench.power_off();
    story.start = bench.machine().flash_cells();
    story.from.outcome = Outcome::New;
    // Nothing of the program is touched.
    story.between = &[];
    let higher = seal_with(sealed_board::sealer_of_epoch(sealed_board::COUNTER + 1, 2), firmware::APP_V2)?;
    story.act = Box::new(move |bench| write_sealed(bench, &higher));
    Ok(story)
}

/// The first bytes of the program's flash with this image, from the emulator's own ELF loader.
fn program_of(image: &str) -> Result<Vec<u8>, String> {
    let chip = firmware::board().chip;
    let mut machine = Machine::new(chip, Options::default()).map_err(|error| error.to_string())?;
    machine.load(&firmware::elf(image)).map_err(|error| error.to_string())?;
    let bytes = program_flash(machine.flash());
    let used = bytes.iter().rposition(|byte| *byte != 0xFF).map_or(0, |last| last + 1);
    Ok(bytes[..used].to_vec())
}
