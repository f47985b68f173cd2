//! The words of the command line.

use std::path::PathBuf;

use boot_core::profile::Profile;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Parser, ValueEnum};
use coflash_core::file::board;
use shared_abi::layout::{self, Layout};

use crate::file_flash::Speed;
use crate::run::Command;

/// Bootloader nodes on a CAN bus of the host, each with a file in place of its flash.
///
/// The nodes run the bootloader of the firmware and accept programs like it. They have no CPU for a
/// program: after the start of a program a node is silent, or a stand-in answers, or a program of the
/// host runs. Ctrl-C cuts the
/// power: everything that a node has reported as stored is in its file.
#[derive(Debug, Parser)]
#[command(name = "coboot-node", version)]
pub struct Args {
    /// An existing bus: socketcand://HOST:PORT/BUS, or another of coflash's adapters
    #[arg(long, value_name = "URL", required_unless_present = "listen")]
    pub bus: Option<String>,

    /// Offer a bus `can0` to socketcand clients at this address, for example 127.0.0.1:29536
    #[arg(long, value_name = "HOST:PORT", conflicts_with = "bus")]
    pub listen: Option<String>,

    /// Node-ID of the first node
    #[arg(long, value_name = "ID", default_value = "1", value_parser = clap::value_parser!(u8).range(1..=127))]
    pub node: u8,

    /// Start the nodes without a node-ID: they wait for layer setting services
    #[arg(long, conflicts_with = "node")]
    pub unconfigured: bool,

    /// Number of nodes; node-ID and serial number count up
    #[arg(long, default_value = "1", value_parser = clap::value_parser!(u8).range(1..=127))]
    pub count: u8,

    /// Serial number of the first node
    #[arg(long, default_value = "1", value_parser = number)]
    pub serial: u32,

    /// Folder of the files, SERIAL.flash for each node, with the raw contents of the flash. A
    /// missing file is created with erased flash
    #[arg(long, default_value = ".", value_name = "DIR")]
    pub folder: PathBuf,

    /// The board with the sectors and programs of the nodes: its name, or the file with its memory map
    #[arg(long, value_name = "BOARD|FILE", default_value = layout::DEFAULT.board, value_parser = board::named)]
    pub board: &'static Layout,

    /// Vendor-ID; with vendor-ID and product code both 0 the nodes accept programs for any product
    #[arg(long, default_value = "0", value_parser = number)]
    pub vendor_id: u32,

    /// Product code
    #[arg(long, default_value = "0", value_parser = number)]
    pub product_code: u32,

    /// Revision number
    #[arg(long, default_value = "0x10000", value_parser = number)]
    pub revision: u32,

    /// Period of the heartbeat in ms, 0 for none
    #[arg(long, default_value = "1000", value_name = "MS")]
    pub heartbeat: u16,

    /// Duration of erase and program operations of the flash
    #[arg(long, value_enum, default_value = "typical")]
    pub flash: FlashSpeed,

    /// The dialect of the nodes where dialects contradict each other
    #[arg(long, default_value = "standard", value_parser = profiles())]
    pub profile: Profile,

    /// Protect blocks and programs with a CRC-16, as in a product with `CrcKind::Crc16`; `coflash
    /// convert --crc16` makes such files
    #[arg(long)]
    pub crc16: bool,

    /// Keep the nodes in the bootloader, also with a program, as with the entry strap set
    #[arg(long)]
    pub stay: bool,

    /// Answer in place of a started program the requests that a host sends to a running application
    #[arg(long)]
    pub stand_in: bool,

    /// The stand-in refuses each command to leave, as an application does whose machine moves.
    /// Includes --stand-in
    #[arg(long)]
    pub refuse: bool,

    /// Start this program of the host in place of a downloaded program, and end it when the device
    /// leaves the program: COMMAND gets the file with the downloaded bytes as its only argument.
    /// Includes --stand-in. Whoever reaches the bus decides what COMMAND reads
    #[arg(long, value_name = "COMMAND", value_parser = Command::find)]
    pub run: Option<Command>,
}

/// The dialects of docs/dialects.md, by their names.
fn profiles() -> impl TypedValueParser<Value = Profile> {
    let word = |(name, help, _)| PossibleValue::new(name).help(help);
    PossibleValuesParser::new(Profile::ALL.map(word)).map(|word| {
        let named = Profile::ALL.into_iter().find(|(name, ..)| *name == word);
        named.map_or(Profile::STANDARD, |(.., profile)| profile)
    })
}

/// The duration of the flash's operations.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum FlashSpeed {
    /// No time
    Instant,
    /// The typical times of the STM32F405/407
    Typical,
}

impl From<FlashSpeed> for Speed {
    fn from(speed: FlashSpeed) -> Self {
        match speed {
            FlashSpeed::Instant => Self::Instant,
            FlashSpeed::Typical => Self::Typical,
        }
    }
}

fn number(text: &str) -> Result<u32, String> {
    let parsed = match text.strip_prefix("0x") {
        // `from_str_radix` would accept a sign.
        Some(digits) if digits.starts_with('+') => None,
        Some(digits) => u32::from_str_radix(digits, 16).ok(),
        None => text.parse().ok().filter(|_| !text.starts_with('+')),
    };
    parsed.ok_or_else(|| "it is not a number of 32 bits (4096 or 0x1000)".to_owned())
}
