//! `emulate`: boards on a virtual CAN bus, for other programs to talk to.

mod flash_file;
mod words;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{bail, Context, Result};
use clap::Parser;
use emulator::bus::Outcome;
use emulator::candump::{Handle, Lines};
use emulator::control::{self, Action, Command};
use emulator::defmt::Decoder;
use emulator::machine::{FlashTimes, Machine, Options, ResetCause, Stop};
use emulator::pacing::{Lag, Pacer, Speed, NAP};
use emulator::periph::usart::Character;
use emulator::rtt;
use emulator::serial::Serial;
use emulator::silicon::Choice;
use emulator::socketcand::Server;
use emulator::supply;
use emulator::time::{Span, Time};
use emulator::world::{MachineId, World};
use flash_file::FlashFile;
use shared_abi::geometry::{self, Geometry, Region};
use shared_abi::layout::toml::Circuit;
use shared_abi::layout::Layout;

/// Runs boards on a virtual CAN bus and shows in words what happens.
///
/// The boards run the very images that go onto real ones. Other programs reach the bus through
/// --socketcand; the adapter behind it is always on the bus and acknowledges. Times are virtual;
/// see --speed. Ctrl-C ends.
#[derive(Debug, Parser)]
#[command(name = "emulate", version)]
struct Args {
    /// The board: its name, or its file, as `cargo xtask build` writes it beside the images. The file has the
    /// crystal, the CAN controller and the UART, too; for a name it is looked for beside the bootloader
    #[arg(long, value_name = "BOARD|FILE", default_value = "stm32f407g-disc1", value_parser = board)]
    board: Board,

    /// The crystal or clock in Hz, where it is not the one of the board
    #[arg(long, value_name = "HZ")]
    hse: Option<u32>,

    /// The CAN controller that the transceiver is at, 1 or 2, where it is not the one of the board
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u8).range(1..=2))]
    can: Option<u8>,

    /// The bootloader's image (ELF, Intel HEX, or FILE@ADDRESS for a raw binary)
    #[arg(long, value_name = "FILE")]
    bootloader: Option<PathBuf>,

    /// An application's image. It is put into flash as a debug probe does it: without a signature
    /// of the bootloader's
    #[arg(long, value_name = "FILE")]
    app: Option<PathBuf>,

    /// More images
    #[arg(value_name = "FILE")]
    images: Vec<PathBuf>,

    /// Serve the bus `can0` to socketcand clients at this address, for example 127.0.0.1:29536
    #[arg(long, value_name = "HOST:PORT")]
    socketcand: Option<String>,

    /// Serve the board's UART to a client, as a pseudo-terminal (`pty`) or over TCP at this
    /// address. Without it, what comes out of a UART is shown as text
    #[arg(long, value_name = "pty|HOST:PORT", conflicts_with = "node_count")]
    serial: Option<String>,

    /// Keep the flash in this file from one run to the next: it is read before the images are put
    /// into flash, created if it is not there, and written at the end and when the power goes off
    #[arg(long, value_name = "FILE", conflicts_with = "node_count")]
    flash: Option<PathBuf>,

    /// Take commands at this address, a line each: `power off|on`, `vdd 2400 in 100` (mV, ms),
    /// `reset`, `pin PC13 low|high|open`, `status`. On a terminal they can be typed as well, `r` for reset and `p` to
    /// switch the power over among them
    #[arg(long, value_name = "HOST:PORT")]
    control: Option<String>,

    /// Let gdb in at this address (`target remote HOST:PORT`). While it has halted the board, time
    /// stands still
    #[arg(long, value_name = "HOST:PORT", conflicts_with = "node_count")]
    gdb: Option<String>,

    /// Bit rate of the adapter that clients talk through, in bit/s
    #[arg(long, default_value_t = 125_000, value_parser = clap::value_parser!(u32).range(1_000..=1_000_000))]
    bit_rate: u32,

    /// Write the bus to this file as a candump log
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,

    /// Error frames go into the log too
    #[arg(long, requires = "trace")]
    trace_errors: bool,

    /// Show every frame, not only the notable ones
    #[arg(short, long)]
    verbose: bool,

    /// How many boards with these images are on the bus. They differ in their unique IDs and in
    /// nothing else, so the images must get different node-IDs out of them
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=32))]
    node_count: u8,

    /// Virtual seconds per second of the wall clock, or `max`: as fast as the host can, but 1:1 for
    /// a moment after every frame that a client gets, so that its answer is not late in virtual
    /// time
    #[arg(long, default_value = "1")]
    speed: Speed,

    /// Chooses what RAM holds at power-on
    #[arg(long, default_value_t = 1)]
    seed: u64,

    /// Flash takes the datasheet's longest times, not the typical ones
    #[arg(long)]
    worst_flash: bool,

    /// Code takes the cycles that the manuals say: loads, branches, fetches from flash and SRAM. Without
    /// it, each instruction takes one
    #[arg(long)]
    costs: bool,

    /// The chip, in what the manuals leave open or give as a range, such as the frequency of the LSI:
    /// `typical`, `worst`, or a seed that draws it; the values are printed. Without it: typical
    #[arg(long, value_name = "SEED|worst|typical")]
    silicon: Option<Choice>,

    /// The supply of the boards (VDD) in mV. The command `vdd` changes it
    #[arg(long, value_name = "MILLIVOLT", default_value_t = supply::NOMINAL, value_parser = clap::value_parser!(u32).range(0..=i64::from(control::MOST_MV)))]
    vdd: u32,

    /// End after so many seconds of virtual time
    #[arg(long = "for", value_name = "SECONDS", value_parser = seconds, allow_negative_numbers = true)]
    run_for: Option<Time>,
}

/// A board, and the circuit around its chip, if its file has it.
#[derive(Clone, Copy, Debug)]
struct Board {
    layout: &'static Layout,
    circuit: Option<Circuit>,
}

fn board(name: &str) -> Result<Board, String> {
    let (layout, circuit) = coboot_linker::board::described(name).map_err(|error| error.to_string())?;
    let chip = layout.chip;
    // A file may contain a chip that nobody makes.
    let memories = |chip: &Geometry| (chip.flash, chip.sram, chip.ccm);
    if !geometry::by_name(chip.chip).is_some_and(|known| memories(known) == memories(chip)) {
        return Err(format!(
            "{name}: there is no {} with these memories; correct [chip] in the file",
            chip.chip
        ));
    }
    Ok(Board { layout, circuit })
}

impl Board {
    /// The circuit around the chip: of the board's file, or of the one that a build has put beside
    /// this bootloader. A board without either has 8 MHz, its transceiver at CAN1, its serial port
    /// at USART2 and no resistors at its pins.
    fn circuit(&self, bootloader: Option<&Path>) -> Circuit {
        let name = self.layout.board;
        let beside = || {
            let file = bootloader?.parent()?.join(format!("{name}.toml"));
            let (layout, circuit) = coboot_linker::board::described(file.to_str()?).ok()?;
            circuit.filter(|_| layout.board == name)
        };
        let plain = Circuit { crystal: 8_000_000, can: 1, usart: "USART2", pulled_up: None };
        self.circuit.or_else(beside).unwrap_or(plain)
    }
}

/// The longest `--for`: 200 days.
const LONGEST: f64 = 200.0 * 86_400.0;

fn seconds(text: &str) -> Result<Time, String> {
    match text.parse::<f64>() {
        // Picoseconds; the range fits.
        Ok(seconds) if (0.0..=LONGEST).contains(&seconds) => Ok(Time((seconds * 1e12) as u64)),
        _ => Err(format!("not a number of seconds from 0 to {LONGEST}")),
    }
}

/// No image of a chip with 1 MiB of flash is larger, ELF with all its debug information included.
const LARGEST_IMAGE: u64 = 256 << 20;
/// The interval at which files are brought up to date.
const FLUSH: Duration = Duration::from_millis(200);
/// How long the world runs without a nap after a client has sent or received something: the
/// client's next message may be on its way.
const AWAKE: Duration = Duration::from_millis(20);
/// The nap while a client at a serial port is possible: such a client cannot wake the world.
const SHORT_NAP: Duration = Duration::from_micros(500);

fn main() -> ExitCode {
    match run(&Args::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        // The reader of the output has closed it.
        Err(error) if error.is::<Unheard>() => ExitCode::SUCCESS,
        Err(error) => {
            // If that cannot be written either, only the exit code reports it.
            let _ = writeln!(io::stderr(), "emulate: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// The reader of the output has closed it.
#[derive(Debug, thiserror::Error)]
#[error("the standard output is closed")]
struct Unheard;

fn print_line(text: &str) -> Result<()> {
    match writeln!(io::stdout(), "{text}") {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Err(Unheard.into()),
        other => other.context("writing to the standard output"),
    }
}

fn run(args: &Args) -> Result<()> {
    let end = Arc::new(AtomicBool::new(false));
    let ended = end.clone();
    ctrlc::set_handler(move || ended.store(true, Ordering::Relaxed)).context("setting up Ctrl-C")?;

    let mut bench = Bench::new(args)?;
    bench.listen(args)?;
    bench.print_silicon(args)?;
    bench.power_on()?;
    let outcome = bench.live(args, &end);
    // The report and the files are written even if an error occurred.
    let printed = bench.print_report();
    let flushed = bench.flush();
    let kept = bench.keep_flash();
    outcome.and(printed).and(flushed).and(kept)?;
    bench.sum_up()
}

/// The images in the order of loading; a later one wins where they overlap.
fn images(args: &Args) -> impl Iterator<Item = &Path> {
    let named = args.bootloader.iter().chain(&args.app);
    named.chain(&args.images).map(PathBuf::as_path)
}

/// Splits FILE@ADDRESS, where FILE@ADDRESS is not itself a file.
fn raw_address(path: &Path) -> Result<Option<(PathBuf, u32)>> {
    let Some((file, address)) = path.to_str().and_then(|text| text.rsplit_once('@')) else { return Ok(None) };
    if path.exists() {
        return Ok(None);
    }
    let digits = address.trim_start_matches("0x").replace('_', "");
    let address = u32::from_str_radix(&digits, 16)
        .with_context(|| format!("{}: `{address}` is not a hexadecimal address", path.display()))?;
    Ok(Some((file.into(), address)))
}

fn read_image(path: &Path) -> Result<Vec<u8>> {
    let size = std::fs::metadata(path).with_context(|| format!("{}", path.display()))?.len();
    if size > LARGEST_IMAGE {
        bail!("{}: {size} bytes are more than any image for this chip has", path.display());
    }
    let bytes = std::fs::read(path).with_context(|| format!("{}", path.display()))?;
    if bytes.is_empty() {
        bail!("{}: the file is empty", path.display());
    }
    Ok(bytes)
}

fn load(machine: &mut Machine, path: &Path) -> Result<()> {
    if let Some((file, address)) = raw_address(path)? {
        let bytes = read_image(&file)?;
        return machine.load_bin(address, &bytes).with_context(|| format!("{}", file.display()));
    }
    let bytes = read_image(path)?;
    let loaded = match std::str::from_utf8(&bytes) {
        _ if bytes.starts_with(b"\x7FELF") => machine.load(&bytes),
        Ok(text) if text.trim_start().starts_with(':') => machine.load_hex(text),
        _ => bail!(
            "{0}: neither ELF nor Intel HEX; for a raw binary say where it goes: {0}@08000000",
            path.display()
        ),
    };
    loaded.with_context(|| format!("{}", path.display()))?;
    Ok(())
}

/// What explains the frames of `defmt` in the images, if one has any.
fn decoder(args: &Args) -> Result<Option<Decoder>> {
    for path in images(args).filter(|path| path.exists()) {
        let bytes = read_image(path)?;
        if bytes.starts_with(b"\x7FELF") {
            let decoder = Decoder::of_elf(&bytes).map_err(anyhow::Error::msg);
            if let Some(decoder) = decoder.with_context(|| format!("{}", path.display()))? {
                return Ok(Some(decoder));
            }
        }
    }
    Ok(None)
}

/// The boards, the bus, and the clients.
struct Bench {
    world: World,
    boards: Vec<Watched>,
    port: emulator::world::PortId,
    server: Option<Server>,
    serial: Option<Serial>,
    control: control::Server,
    gdb: Option<emulator::gdb::Door>,
    flash: Option<FlashFile>,
    trace: Option<(PathBuf, Handle<BufWriter<File>>)>,
    /// The messages that are not printed yet, with their times.
    unprinted: Rc<RefCell<Vec<(Time, String)>>>,
}

/// A board, how many of its reports have been shown, and the messages that it writes for a debug
/// probe.
struct Watched {
    id: MachineId,
    shown: usize,
    sram: Region,
    log: rtt::Reader,
    /// When its RAM is searched for messages next.
    poll: Time,
    /// The incomplete lines that its USARTs have sent, by name and bit rate.
    serial: BTreeMap<(&'static str, u32), Vec<u8>>,
}

/// A line that comes out of a USART is cut here, if the program does not end it.
const LONGEST_LINE: usize = 256;

impl Watched {
    /// The text that its USARTs have sent since the last call, with the time of its end: of all but the one
    /// that a client has, whose bytes are the client's.
    fn serial(&mut self, machine: &mut Machine, of_client: Option<&str>) -> Vec<(Time, String)> {
        let mut lines = Vec::new();
        let usarts = machine.usarts_mut().iter_mut();
        for usart in usarts.filter(|usart| Some(usart.instance().name) != of_client) {
            let name = usart.instance().name;
            for Character { end, byte, bit_rate } in usart.take_sent() {
                let line = self.serial.entry((name, bit_rate)).or_default();
                if byte != b'\n' && line.len() < LONGEST_LINE {
                    line.push(byte);
                    continue;
                }
                let text = String::from_utf8_lossy(line).trim_end().escape_default().to_string();
                line.clear();
                lines.push((end, format!("{name} ({bit_rate} bit/s): {text}")));
            }
        }
        lines
    }
}

/// Steps that a debugger gets before the others are looked after.
const STEPS: usize = 100;
/// How long a step may take before it waits for the wall clock as everything does.
const STEP: Span = Span::from_micros(10);

/// How much virtual time passes at most before the clients are looked after. A frame with data takes longer.
const SLICE: Span = Span::from_micros(100);

/// How often a board's RAM is looked at for what it reports to a debug probe.
const POLL: Span = Span::from_millis(5);

impl Bench {
    fn new(args: &Args) -> Result<Self> {
        let (chip, circuit) = (args.board.layout.chip, args.board.circuit(args.bootloader.as_deref()));
        let mut flash = None;
        let mut world = World::new();
        let mut boards = Vec::new();
        for n in 0..args.node_count {
            let mut unique_id = Options::default().unique_id;
            unique_id[0] += u32::from(n);
            let machine = Machine::new(
                chip,
                Options {
                    seed: args.seed.wrapping_add(u64::from(n)),
                    hse_hz: args.hse.unwrap_or(circuit.crystal),
                    flash_times: if args.worst_flash { FlashTimes::Worst } else { FlashTimes::Typical },
                    unique_id,
                    costs: args.costs,
                    transceiver: usize::from(args.can.unwrap_or(circuit.can)) - 1,
                    silicon: args.silicon.unwrap_or(Choice::Typical).of_board(n.into()),
                    vdd_mv: args.vdd,
                    ..Options::default()
                },
            );
            let mut machine = machine.context("setting up the board")?;
            if let Some((port, pin)) = circuit.pulled_up {
                machine.set_pin(port, pin, Some(true));
            }
            if let Some(path) = &args.flash {
                flash = Some(FlashFile::open(path, chip, &mut machine)?);
            }
            if images(args).next().is_none() && !flash.as_ref().is_some_and(FlashFile::is_filled) {
                bail!("the flash would be empty: name at least one image, for example --bootloader FILE");
            }
            for path in images(args) {
                load(&mut machine, path)?;
            }
            boards.push(Watched {
                id: world.add_machine(machine),
                shown: 0,
                sram: chip.sram,
                log: rtt::Reader::with(decoder(args)?),
                poll: Time(0),
                serial: BTreeMap::new(),
            });
        }
        let port = world.add_host_port(args.bit_rate);
        let trace = match &args.trace {
            None => None,
            Some(path) => {
                let file = File::create(path).with_context(|| format!("{}", path.display()))?;
                let lines = if args.trace_errors { Lines::FramesAndErrors } else { Lines::Frames };
                let log = Handle::new(BufWriter::new(file), "can0", lines);
                world.add_sink(log.sink());
                Some((path.clone(), log))
            }
        };
        let unprinted = Rc::new(RefCell::new(Vec::new()));
        let (mut words, messages, verbose) = (words::Words::default(), unprinted.clone(), args.verbose);
        world.add_sink(move |record| {
            let text = words.of(record);
            let frame = match record.outcome {
                Outcome::Good if verbose => Some(record.frame.to_string()),
                Outcome::KeptBack if verbose => Some(format!("{} (kept back)", record.frame)),
                _ => None,
            };
            messages.borrow_mut().extend(frame.into_iter().chain(text).map(|text| (record.end, text)));
        });
        Ok(Self {
            world,
            boards,
            port,
            server: None,
            serial: None,
            control: control::Server::new(),
            gdb: None,
            flash,
            trace,
            unprinted,
        })
    }

    fn listen(&mut self, args: &Args) -> Result<()> {
        if let Some(address) = &args.socketcand {
            let server = Server::bind(address.as_str(), "can0").with_context(|| {
                format!("cannot listen at {address}; is another emulator running? choose another port")
            })?;
            print_line(&format!("clients reach the bus at socketcand://{}/can0", server.address()))?;
            self.server = Some(server);
        }
        if let Some(place) = &args.serial {
            let usart = args.board.circuit(args.bootloader.as_deref()).usart;
            if self.world.machine_mut(self.boards[0].id).usart_mut(usart).is_none() {
                bail!(
                    "the {} has no {usart}: correct `usart` in the board's file",
                    args.board.layout.chip.chip
                );
            }
            let serial = match place.as_str() {
                #[cfg(unix)]
                "pty" => Serial::terminal(usart).context("a pseudo-terminal")?,
                address => {
                    Serial::listen(usart, address).with_context(|| format!("cannot listen at {address}"))?
                }
            };
            print_line(&format!("{usart} is at {}", serial.place()))?;
            self.serial = Some(serial);
        }
        if let Some(address) = &args.control {
            let at = self.control.listen(address.as_str());
            let at = at.with_context(|| format!("cannot listen at {address}"))?;
            print_line(&format!("commands are taken at {at}"))?;
        }
        if io::stdin().is_terminal() && io::stdout().is_terminal() {
            self.control.read_terminal().context("reading the terminal")?;
        }
        if let Some(address) = &args.gdb {
            let door = emulator::gdb::Door::bind(address.as_str());
            let door = door.with_context(|| format!("cannot listen at {address}"))?;
            print_line(&format!("gdb reaches the board by `target remote {}`", door.address()))?;
            self.gdb = Some(door);
        }
        Ok(())
    }

    /// Prints which chips were chosen, if the user chose: a failure can then be seen again.
    fn print_silicon(&self, args: &Args) -> Result<()> {
        let Some(choice) = args.silicon else { return Ok(()) };
        for n in 0..self.boards.len() {
            let silicon = self.world.machine(self.boards[n].id).silicon();
            print_line(&format!("{}: silicon {choice}: {silicon}", self.name(n)))?;
        }
        Ok(())
    }

    fn power_on(&mut self) -> Result<()> {
        for n in 0..self.boards.len() {
            self.world.power_on(self.boards[n].id);
            let name = self.name(n);
            print_line(&format!("{} {name}: power on", self.world.now()))?;
        }
        Ok(())
    }

    fn name(&self, n: usize) -> String {
        match self.boards.len() {
            1 => "board".into(),
            _ => format!("board {}", n + 1),
        }
    }

    /// Runs the world until its end is requested or due.
    fn live(&mut self, args: &Args, end: &AtomicBool) -> Result<()> {
        let last = args.run_for.unwrap_or(Time(u64::MAX));
        let mut pacer = Pacer::new(args.speed, Instant::now(), self.world.now());
        let mut lag = Lag::new(args.speed);
        let mut flushed = Instant::now();
        let mut awake_until = flushed;
        while !end.load(Ordering::Relaxed) && self.world.now() < last {
            // What clients sent while the host held this program up comes before the time that is caught
            // up on: otherwise it would come late in the eyes of the device.
            if self.exchange(&mut pacer) {
                awake_until = Instant::now() + AWAKE;
            }
            let (wall, now) = (Instant::now(), self.world.now());
            let halted = self.world.is_halted();
            if halted {
                // Time is stopped, and nothing of it is caught up on.
                pacer = Pacer::new(args.speed, wall, now);
                lag = Lag::new(args.speed);
            }
            let target = pacer.target(wall, now).min(last);
            let awake = wall < awake_until || target == last || pacer.is_worth_it(now, target);
            if target > now && awake && !halted {
                let slice = if wall < awake_until { SLICE } else { target - now };
                self.run_in_slices(target, slice, &mut pacer);
            } else {
                // The threads of the clients unpark this one.
                let nap = if self.serial.is_some() || wall < awake_until { SHORT_NAP } else { NAP };
                std::thread::park_timeout(nap);
                if wall.elapsed() < nap {
                    awake_until = Instant::now() + AWAKE;
                }
            }
            if let Some(text) = lag.check(wall, now) {
                self.unprinted.borrow_mut().push((now, text));
            }
            self.obey()?;
            self.print_report()?;
            if flushed.elapsed() > FLUSH {
                self.flush()?;
                flushed = Instant::now();
            }
        }
        Ok(())
    }

    /// Runs the world to `target`, or until a client has got something. While the device works more than the host keeps
    /// up with, as when it programs what came in during an erase, a step takes many milliseconds of the wall clock: a
    /// request does not wait for its end, and neither does an answer.
    fn run_in_slices(&mut self, target: Time, slice: Span, pacer: &mut Pacer) {
        while self.world.now() < target && !self.world.is_halted() {
            self.world.run_until(target.min(self.world.now() + slice));
            if self.world.now() < target && self.exchange(pacer) {
                break;
            }
        }
    }

    /// Lets the clients take part; whether one has got something.
    fn exchange(&mut self, pacer: &mut Pacer) -> bool {
        self.debug();
        let mut delivered = 0;
        if let Some(serial) = &mut self.serial {
            delivered += serial.exchange(self.world.machine_mut(self.boards[0].id));
        }
        if let Some(server) = &mut self.server {
            delivered += server.exchange(&mut self.world, self.port);
            let now = self.world.now();
            self.unprinted.borrow_mut().extend(server.notices().into_iter().map(|notice| (now, notice)));
        } else {
            // These frames have no receiver.
            while self.world.receive(self.port).is_some() {}
        }
        if delivered > 0 {
            pacer.delivered(Instant::now());
        }
        delivered > 0
    }

    /// Lets gdb take part. A step does not wait for the wall clock.
    fn debug(&mut self) {
        let Some(door) = &mut self.gdb else { return };
        let board = self.boards[0].id;
        for _ in 0..STEPS {
            let halted = self.world.is_halted();
            door.exchange(self.world.machine_mut(board));
            if !halted || self.world.is_halted() {
                break;
            }
            self.world.run_for(STEP);
        }
        let now = self.world.now();
        self.unprinted.borrow_mut().extend(door.notices().into_iter().map(|notice| (now, notice)));
    }

    /// Carries out the requests of the control socket and the terminal.
    fn obey(&mut self) -> Result<()> {
        while let Some(request) = self.control.take() {
            let outcome = self.act(request.command);
            // The client gets the failure as its answer; it is also printed for the emulator's
            // user.
            let failed = outcome.as_ref().err().map(|error| format!("{error:#}"));
            request.answer(outcome.map_err(|error| format!("{error:#}")));
            if let Some(text) = failed {
                self.unprinted.borrow_mut().push((self.world.now(), format!("a command failed: {text}")));
            }
        }
        Ok(())
    }

    fn act(&mut self, Command { board, action }: Command) -> Result<String> {
        let boards = self.boards.len();
        let Some(id) = self.boards.get(board).map(|board| board.id) else {
            bail!("there is no board {}: there are {boards}", board + 1);
        };
        let on = self.world.machine(id).is_powered();
        let on = match action {
            Action::Power(on) => on,
            Action::TogglePower => !on,
            Action::Supply { .. } | Action::Reset | Action::Pin { .. } | Action::Status => on,
        };
        let done = match action {
            Action::Power(_) | Action::TogglePower if on => {
                self.world.power_on(id);
                Some("power on".to_owned())
            }
            Action::Power(_) | Action::TogglePower => {
                self.world.power_off(id);
                self.keep_flash()?;
                Some("power off".to_owned())
            }
            Action::Supply { mv, within_ms } => {
                self.world.machine_mut(id).set_supply(mv, Span::from_millis(within_ms.into()));
                let within = if within_ms > 0 { format!(" within {within_ms} ms") } else { String::new() };
                Some(format!("VDD goes to {mv} mV{within}"))
            }
            Action::Reset => {
                if !on {
                    bail!("its power is off");
                }
                self.world.machine_mut(id).reset_pin();
                Some("reset by the pin NRST".to_owned())
            }
            Action::Pin { port, pin, level } => {
                self.world.machine_mut(id).set_pin(port, pin, level);
                let level = level.map_or("open", |high| if high { "high" } else { "low" });
                Some(format!("P{port}{pin} is {level} from outside"))
            }
            Action::Status => None,
        };
        let now = self.world.now();
        if let Some(text) = done {
            let line = format!("{}: {text}", self.name(board));
            self.unprinted.borrow_mut().push((now, line));
            return Ok(text);
        }
        let machine = self.world.machine(id);
        let state = match (on, machine.halted()) {
            (false, _) => "power off",
            (true, Some(_)) => "halted by the debugger",
            (true, None) if machine.is_in_standby() => "in Standby",
            (true, None) if machine.is_held_in_reset() => "held in reset by its supply",
            (true, None) => "runs",
        };
        let (name, vdd, pc) = (self.name(board), machine.supply(), machine.pc());
        Ok(format!("{now} s, {name}: {state}, pc {pc:08X}h, VDD {vdd} mV"))
    }

    fn keep_flash(&mut self) -> Result<()> {
        match &mut self.flash {
            Some(file) => file.keep(self.world.machine(self.boards[0].id).flash()),
            None => Ok(()),
        }
    }

    /// Prints the events since the last call, in their order in time.
    fn print_report(&mut self) -> Result<()> {
        let of_client = self.serial.as_ref().map(Serial::usart);
        let mut lines = std::mem::take(&mut *self.unprinted.borrow_mut());
        while let Some(news) = self.world.news() {
            let n = self.boards.iter().position(|board| board.id == news.machine).unwrap_or(0);
            if let Some(text) = happened(news.stop, || self.world.machine(news.machine).fault_cause()) {
                lines.push((news.at, format!("{}: {text}", self.name(n))));
            }
        }
        for n in 0..self.boards.len() {
            let (name, board) = (self.name(n), &mut self.boards[n]);
            let reports = self.world.machine(board.id).reports();
            let new = reports.get(board.shown..).unwrap_or_default();
            lines.extend(new.iter().map(|report| (report.time, format!("{name}: {}", report.words()))));
            board.shown = reports.len();
            let now = self.world.now();
            lines.extend(
                board
                    .serial(self.world.machine_mut(board.id), of_client)
                    .into_iter()
                    .map(|(at, line)| (at, format!("{name}: {line}"))),
            );
            if now >= board.poll {
                board.poll = now + POLL;
                let logged = board.log.lines(self.world.machine_mut(board.id), board.sram);
                lines.extend(logged.into_iter().map(|line| (now, format!("{name}: log: {line}"))));
            }
        }
        lines.sort_by_key(|(at, _)| *at);
        lines.iter().try_for_each(|(at, line)| print_line(&format!("{at} {line}")))
    }

    fn flush(&self) -> Result<()> {
        match &self.trace {
            Some((path, log)) => log.flush().with_context(|| format!("writing {}", path.display())),
            None => Ok(()),
        }
    }

    fn sum_up(&self) -> Result<()> {
        let (frames, errors) = self.world.bus().totals();
        print_line(&format!("{} end: {frames} frames, {errors} error frames", self.world.now()))?;
        for n in 0..self.boards.len() {
            let reports = self.world.machine(self.boards[n].id).reports();
            let times: u64 = reports.iter().map(|report| report.count).sum();
            if times > 0 {
                let places = reports.len();
                print_line(&format!(
                    "{}: {times} accesses, in {places} places, that the emulator does not model",
                    self.name(n)
                ))?;
            }
        }
        Ok(())
    }
}

/// The event of a board in words; `None` for an event that was requested.
fn happened(stop: Stop, cause: impl Fn() -> String) -> Option<String> {
    Some(match stop {
        Stop::Deadline | Stop::Attention | Stop::Halted => return None,
        Stop::Reset(ResetCause::PowerOn) => "the supply is back after a power-down".into(),
        Stop::Reset(ResetCause::BrownOut) => "the supply is back after a brown-out".into(),
        Stop::Reset(ResetCause::Pin) => "reset by the pin NRST".into(),
        Stop::Reset(ResetCause::Software) => "reset by its software".into(),
        Stop::Reset(ResetCause::IndependentWatchdog) => "reset by the watchdog".into(),
        Stop::Reset(ResetCause::WindowWatchdog) => "reset by the window watchdog".into(),
        Stop::Reset(ResetCause::LowPower) => "reset in place of Stop or Standby (option bytes)".into(),
        Stop::Reset(ResetCause::Standby) => "woke up from Standby".into(),
        Stop::PowerCut => "the power is cut".into(),
        Stop::Lockup => {
            format!("the CPU has locked up by {}: only a reset helps it", cause())
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The circuit comes from the board's file, and for a board's name from the file beside the bootloader.
    #[test]
    fn a_board_has_the_circuit_of_its_file() {
        let folder = std::env::temp_dir().join(format!("coboot-emulate-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let own = Circuit { crystal: 25_000_000, can: 2, usart: "USART1", pulled_up: Some(('A', 0)) };
        let map = include_str!("../../../tests/it/my-board.toml");
        let bootloader = folder.join("bootloader.elf");
        let circuit = |word: &str, beside| board(word).unwrap().circuit(beside);
        let plain = Circuit { crystal: 8_000_000, can: 1, usart: "USART2", pulled_up: None };
        // A name may have a dot; then it is that of a file, which needs no circuit of its own.
        let other = folder.join("other.toml");
        std::fs::write(&other, map.replace("my-board", "my.board")).unwrap();
        for (name, word) in [("nucleo-f446re", "nucleo-f446re"), ("my.board", other.to_str().unwrap())] {
            let file = folder.join(format!("{name}.toml"));
            std::fs::write(&file, format!("{}{own}", map.replace("my-board", name))).unwrap();
            assert_eq!(circuit(file.to_str().unwrap(), None), own);
            assert_eq!(circuit(word, Some(&bootloader)), own);
            assert_eq!(circuit(word, None), plain);
            // The file is that of another board.
            std::fs::write(&file, format!("{map}{own}")).unwrap();
            assert_eq!(circuit(word, Some(&bootloader)), plain);
        }
        std::fs::remove_dir_all(folder).unwrap();
    }
}
