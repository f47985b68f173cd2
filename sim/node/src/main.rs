//! `coboot-node`: bootloader nodes on a bus of the host.
#![forbid(unsafe_code)]

use std::error::Error;
use std::io::{self, Write};
use std::process::ExitCode;
use std::time::Duration;

use boot_core::bootloader::{self, entries, entry_count, Extras};
use boot_core::canopen::device;
use boot_core::canopen::od::Entry;
use boot_core::canopen::{BitRate, Instant, NodeId};
use boot_core::control::Policy;
use boot_core::crc::CrcKind;
use boot_core::profile::Profile;
use boot_core::store::NodeParameters;
use clap::Parser;
use coboot_can::Adapter;
use coboot_node::args::Args;
use coboot_node::device::{Device, Event, Setup, BUFFER};
use coboot_node::file_flash::FileFlash;
use coboot_node::server::Server;
use coboot_node::stand_in::StandIn;
use coboot_node::supports;

/// The interval between two time steps of the nodes while nothing happens.
const TICK: Duration = Duration::from_millis(2);

fn main() -> ExitCode {
    let args = Args::parse();
    let result = match args.board.programs.len() {
        1 => run::<1>(&args),
        2 => run::<2>(&args),
        programs => Err(format!("a board with {programs} programs is not known here").into()),
    };
    match result {
        Ok(never) => match never {},
        Err(error) => {
            // If this fails, too, only the exit code remains.
            let _ = writeln!(io::stderr(), "coboot-node: {error}");
            ExitCode::FAILURE
        }
    }
}

/// The object dictionary of a device with this many programs.
fn table_of(programs: usize, extras: Extras) -> &'static [Entry] {
    macro_rules! one_of {
        ($($programs:literal $extras:expr),*) => {
            match (programs, extras) {
                $((_, _) if programs == $programs && extras == $extras => {
                    const LEN: usize = entry_count($programs, $extras);
                    static ENTRIES: [Entry; LEN] = entries($programs, $extras).entries();
                    &ENTRIES
                })*
                _ => unreachable!("one or two programs, and one of the profiles"),
            }
        };
    }
    one_of!(
        1 Profile::STANDARD.extras, 1 Profile::ESACADEMY.extras, 1 Profile::LIFT.extras,
        2 Profile::STANDARD.extras, 2 Profile::ESACADEMY.extras, 2 Profile::LIFT.extras
    )
}

fn run<const PROGRAMS: usize>(args: &Args) -> Result<std::convert::Infallible, Box<dyn Error>> {
    let setups = setups(args, PROGRAMS)?;
    let mut flashes = Vec::new();
    for setup in &setups {
        let path = args.folder.join(format!("{}.flash", setup.serial_number));
        let flash = FileFlash::open(&path, args.board, args.flash.into())
            .map_err(|error| format!("{}: {error}", path.display()))?;
        flashes.push(flash);
    }
    let mut bus: Box<dyn Adapter> = match (&args.bus, &args.listen) {
        (Some(url), _) => coboot_can::open(url).map_err(|error| format!("{error}; {}", error.advice()))?,
        (None, Some(address)) => {
            let server =
                Server::bind(address, "can0").map_err(|error| format!("listening at {address}: {error}"))?;
            print_line(&format!("bus: socketcand://{}/can0", server.address()));
            Box::new(server)
        }
        (None, None) => return Err("no bus is named: give --bus URL or --listen HOST:PORT".into()),
    };

    let mut buffers = vec![[0; BUFFER]; setups.len()];
    let mut devices = Vec::new();
    for ((setup, flash), buffer) in setups.into_iter().zip(flashes).zip(&mut buffers) {
        let (device, event) = Device::<PROGRAMS>::hosted(setup, args.run.as_ref(), flash, buffer);
        log_event(args, setup.serial_number, event);
        devices.push((setup.serial_number, device));
    }
    // The first pass is the boot-up: a request that is there already is answered after it.
    let mut frame = None;
    loop {
        // Wraps after 49 days, as on the chip.
        let now = Instant::from_millis(bus.now().as_millis() as u32);
        let mut more = frame.is_some();
        for (serial, device) in &mut devices {
            if let Some(frame) = &frame {
                device.handle(frame, now);
            }
            let mut sent = Ok(());
            let mut send = |frame| {
                if sent.is_ok() {
                    sent = bus.send(&frame);
                }
            };
            more |= device
                .work(now, &mut send, &mut |event| log_event(args, *serial, event))
                .map_err(|error| format!("the file of serial number {serial} cannot be written: {error}"))?;
            sent?;
        }
        // The nodes are slaves: the frames of one node do not concern the others.
        frame = bus.receive(if more { Duration::ZERO } else { TICK })?;
    }
}

/// The setups of the nodes, which live as long as the process.
fn setups(args: &Args, programs: usize) -> Result<Vec<Setup>, Box<dyn Error>> {
    let profile = args.profile;
    let config: &'static bootloader::Config = Box::leak(Box::new(bootloader::Config {
        entries: table_of(programs, profile.extras),
        device: device::Device {
            device_type: profile.device_type,
            name: "coboot-node",
            hardware_version: "none",
            software_version: concat!("coboot ", env!("CARGO_PKG_VERSION")),
            heartbeat_ms: args.heartbeat,
            vendor_id: args.vendor_id,
            product_code: args.product_code,
            revision: args.revision,
            serial_number: 0,
        },
        node_id: profile.node_id,
        layout: args.board,
        supports,
        boot_up_emergency: true,
        download: Policy {
            identity: Some((args.vendor_id, args.product_code)),
            crc: if args.crc16 { CrcKind::Crc16 } else { CrcKind::Crc32 },
            ..profile.download
        },
        password: profile.password,
    }));
    let stand_in: Option<&'static [Entry]> = (args.stand_in || args.refuse || args.run.is_some())
        .then(|| &*Vec::leak(StandIn::entries(programs as u8)));
    let setup = |n: u8| -> Option<Setup> {
        let id = match args.unconfigured {
            true => None,
            false => Some(NodeId::new(args.node.checked_add(n)?)?),
        };
        Some(Setup {
            config,
            stand_in,
            refuses: args.refuse,
            serial_number: args.serial.checked_add(n.into())?,
            node: NodeParameters { id, bit_rate: BitRate::K125 },
            strap: args.stay,
        })
    };
    let setups: Option<Vec<Setup>> = (0..args.count).map(setup).collect();
    Ok(setups.ok_or("with this first number and count, the nodes exceed the node-IDs (1 to 127) or the serial numbers (32 bits)")?)
}

/// Prints the result of a reset.
fn log_event(args: &Args, serial: u32, event: Event) {
    let (node, what) = match event {
        Event::NodeId(node) => (Some(node), "node-ID set by LSS".to_owned()),
        Event::Bootloader { node, reason } => (node, format!("bootloader ({reason:?})")),
        Event::Program { number, trial, node } => {
            let trial = if trial { ", on trial" } else { "" };
            let starts = if args.run.is_some() { "starts" } else { "would start" };
            (node, format!("{starts} program {number}{trial}"))
        }
        Event::Ended { number, ending } => {
            return print_line(&format!("serial {serial}: program {number} {ending}"));
        }
    };
    let node = node.map_or("no node-ID".to_owned(), |node| format!("node {}", node.get()));
    print_line(&format!("serial {serial}, {node}: {what}"));
}

fn print_line(line: &str) {
    // An error of standard output is ignored.
    let _ = writeln!(io::stdout(), "{line}");
}
