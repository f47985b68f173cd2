//! The cost of a frame for the host: an update through a socketcand bus on this computer, into a
//! node with a flash that takes no time.
//!
//! `cargo xtask bench` runs it. Nothing waits for a wire, so the rate shows the speed of tool,
//! system and node together; the processor time is that of the tool alone.

use std::error::Error;
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use std::{env, fs};

use boot_core::canopen::{Frame, NodeId};
use coboot_can::{Adapter, AdapterError};
use coflash_core::device::{Session, Timing, Transfers};
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::file::read::{read, Format};
use coflash_core::file::Program;
use coflash_core::update::{flash, FlashOptions};
use shared_abi::layout::stm32f407g_disc1::LAYOUT;

const SIZES: [u32; 2] = [256, 896];
const TRANSFERS: [(Transfers, &str); 2] = [(Transfers::Blocks, "blocks"), (Transfers::Segments, "segments")];

/// The bus, with counters of its frames.
struct Counted {
    bus: Box<dyn Adapter>,
    frames: u64,
}

impl Adapter for Counted {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.frames += 1;
        self.bus.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let received = self.bus.receive(timeout)?;
        self.frames += u64::from(received.is_some());
        Ok(received)
    }

    fn now(&self) -> Duration {
        self.bus.now()
    }
}

/// A node in its own process, which ends when this value is dropped.
struct Node {
    child: Child,
    folder: PathBuf,
    url: String,
}

impl Node {
    fn start() -> Result<Self, Box<dyn Error>> {
        let folder = env::temp_dir().join(format!("coboot-cost-{}", std::process::id()));
        fs::create_dir_all(&folder)?;
        // Examples are in a folder beside the programs.
        let program = env::current_exe()?;
        let programs =
            program.parent().and_then(|folder| folder.parent()).ok_or("no folder above this one")?;
        let program = programs.join("coboot-node").with_extension(env::consts::EXE_EXTENSION);
        let mut child = Command::new(&program)
            .args(["--listen", "127.0.0.1:0", "--flash", "instant", "--heartbeat", "0", "--folder"])
            .arg(&folder)
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| {
                format!("{}: {error}; build it by `cargo build -p coboot-node`", program.display())
            })?;
        let mut line = String::new();
        BufReader::new(child.stdout.take().ok_or("no output")?).read_line(&mut line)?;
        let url = line.trim().strip_prefix("bus: ").unwrap_or_default().to_owned();
        Ok(Self { child, folder, url })
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        // The node may have ended already; no other program uses its folder.
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = fs::remove_dir_all(&self.folder);
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let json = match env::args().nth(1).as_deref() {
        None => false,
        Some("--json") => true,
        Some(other) => return Err(format!("{other:?} is not an option; the only option is --json").into()),
    };
    if !json {
        println!("An update over socketcand on this machine, into a node whose flash takes no time.\n");
        println!("  transfer   KiB    frames     measured   frames/s    processor per frame");
    }
    let mut rows = Vec::new();
    for (transfers, name) in TRANSFERS {
        for kib in SIZES {
            let file = program(kib)?;
            // A new node for each run: the first update of a node has nothing to erase.
            let node = Node::start()?;
            let mut bus = Counted { bus: coboot_can::open(&node.url)?, frames: 0 };
            let mut session = Session::new(&mut bus, NodeId::new(1).ok_or("no node-ID")?, Timing::default());
            session.transfer_by(transfers);
            let options = FlashOptions::default().start(false);
            let (began, before) = (Instant::now(), processor_time());
            flash(&mut session, &file, &options, &mut |_| {})?;
            let took = began.elapsed();
            let used = processor_time().zip(before).map(|(after, before)| after.saturating_sub(before));
            let frames = bus.frames;
            let per_second = frames as f64 / took.as_secs_f64();
            let per_frame = used.map(|used| used.as_nanos() as f64 / frames as f64 / 1000.0);
            if json {
                let used = used.map_or("null".to_owned(), |used| used.as_micros().to_string());
                rows.push(format!(
                    "  {{\"transfer\": \"{name}\", \"kib\": {kib}, \"frames\": {frames}, \"measured_us\": {}, \
                     \"frames_per_second\": {per_second:.0}, \"processor_us\": {used}}}",
                    took.as_micros()
                ));
            } else {
                let per_frame = per_frame.map_or("not known here".to_owned(), |us| format!("{us:.2} us"));
                println!(
                    "{name:>10} {kib:>5} {frames:>9} {:>10.3} s {per_second:>10.0} {per_frame:>22}",
                    took.as_secs_f64()
                );
            }
        }
    }
    if json {
        println!("[\n{}\n]", rows.join(",\n"));
    }
    Ok(())
}

/// The processor time of this thread, the only one that works; `None` if the system does not report
/// it.
fn processor_time() -> Option<Duration> {
    let text = fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    text.split_ascii_whitespace().next()?.parse().ok().map(Duration::from_nanos)
}

/// A program's bytes, with vectors that a bootloader accepts.
fn program(kib: u32) -> Result<Program, Box<dyn Error>> {
    let region = LAYOUT.programs[0];
    let mut bytes: Vec<u8> =
        (0..kib * 1024).map(|i| (i.wrapping_mul(2_654_435_761).rotate_left(9) >> 24) as u8).collect();
    bytes[..4].copy_from_slice(&(LAYOUT.ram.base + 0x1000).to_le_bytes());
    bytes[4..8].copy_from_slice(&(region.base + 0x201).to_le_bytes());
    let image = read(&bytes, Some(Format::Raw), Some(region.base)).map_err(|error| format!("{error:?}"))?;
    let options = Options::default().region(Region::Strict(region.into()));
    Ok(program_of(image, &options)?.program)
}
