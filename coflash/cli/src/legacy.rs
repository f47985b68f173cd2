//! The options of the manual's download tools that this tool handles differently (tables 9 and 11).
//! They are accepted, so that a script works after only the program's name was changed.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use canopen::NodeId;
use clap::Args;
use coflash_core::device::lss::LssAddress;

use super::context::Context;
use super::output::Failure;
use super::values::{nodes, number, program_number};

/// The options that have no effect here, or have another spelling.
#[derive(Debug, Args)]
#[command(next_help_heading = "Options of the manual's tools")]
pub(super) struct Legacy {
    /// The firmware file in DotNetFlashtool's spelling.
    #[arg(short = 'F', value_name = "FILE", hide = true)]
    legacy_file: Option<PathBuf>,

    /// The node-ID in its spelling.
    #[arg(long = "node_id", value_name = "1..126", value_parser = nodes_of_its_devices, hide = true)]
    node_id: Option<Vec<Vec<NodeId>>>,

    /// The program number in its spelling.
    #[arg(long = "prog_no", value_name = "1..254", value_parser = program_number, hide = true)]
    prog_no: Option<u8>,

    /// The trial, which its other words leave out.
    #[arg(long = "chk_run", hide = true)]
    chk_run: bool,

    /// The bit rate as an index (0 is 1 Mbit/s, 2 is 500, 3 is 250, 4 is 125 kbit/s), for adapters
    /// that set the bit rate; ? lists all indices.
    #[arg(short = 'B', alias = "br_idx", long = "bit-rate-index", value_name = "0..8", value_parser = index,
          overrides_with = "baudrate", hide_short_help = true)]
    index: Option<Index>,

    /// The bit rate in kbit/s, for adapters that set it; with --vxd_type 16 the bit rate of the
    /// serial line in bit/s.
    #[arg(long, alias = "baurate", value_name = "KBITS", value_parser = number, overrides_with = "index", hide_short_help = true)]
    baudrate: Option<u32>,

    /// A value above 0 is --check-target.
    #[arg(long = "chk_tgt", value_name = "VALUE", value_parser = number, hide = true)]
    chk_tgt: Option<u32>,

    /// Give the device with this LSS address the node-ID of --node first: the serial number of the
    /// address.
    #[arg(long = "ser_num", value_name = "NUMBER", value_parser = number, hide_short_help = true)]
    serial: Option<u32>,

    /// The revision of the LSS address.
    #[arg(long = "rev", value_name = "NUMBER", value_parser = number, hide_short_help = true)]
    revision: Option<u32>,

    /// The product code of the LSS address.
    #[arg(long = "pcode", value_name = "NUMBER", value_parser = number, hide_short_help = true)]
    product: Option<u32>,

    /// The vendor-ID of the LSS address; by default 0x3F.
    #[arg(long = "vendor", value_name = "NUMBER", value_parser = number, hide_short_help = true)]
    vendor: Option<u32>,

    /// The PC's CAN interface, by the manual's number: ? lists the numbers with the URL for --bus.
    #[arg(long = "vxd_type", value_name = "1..16", value_parser = interface, hide_short_help = true)]
    vxd_type: Option<Interface>,

    #[arg(long = "device_no", value_name = "VALUE", value_parser = number, hide = true)]
    device_no: Option<u32>,

    #[arg(long = "ip_addr", value_name = "VALUE", hide = true)]
    ip_addr: Option<String>,

    #[arg(long = "ip_port", value_name = "VALUE", hide = true)]
    ip_port: Option<String>,

    #[arg(long = "gateway_id", value_name = "VALUE", value_parser = number, hide = true)]
    gateway_id: Option<u32>,

    #[arg(long = "network_id", value_name = "VALUE", value_parser = number, hide = true)]
    network_id: Option<u32>,
}

/// `--br_idx`.
#[derive(Clone, Copy, Debug)]
enum Index {
    /// `?`: list the indices.
    List,
    /// In bit/s.
    Rate(u32),
}

/// `--vxd_type`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Interface {
    /// `?`: list the interfaces.
    List,
    /// Its number in table 12.
    Type(u32),
}

/// Table 13, in the order of the indices.
const KILOBITS: [u32; 9] = [1000, 800, 500, 250, 125, 100, 50, 20, 10];

/// Chapter 5.3: the tool's own node-ID.
const ITS_OWN_NODE_ID: u8 = 127;

/// The CAN-Ethernet gateway (table 12).
const CAN_ETHERNET: u32 = 14;
/// CAN over a serial line (table 12).
const VIRTUAL_CAN: u32 = 16;
/// The bit rate of that line in the manual and in this tool.
const SERIAL_BIT_RATE: u32 = 115_200;

/// Table 12, shortened: the interface, and the URL for it in this tool, on Linux with the kernel's
/// driver and on Windows with the maker's library. PCAN-Basic has no plug-and-play channel for a
/// dongle, and SYS TEC's library is not one of those that this tool loads.
const INTERFACES: [(&str, &str, &str); 16] = [
    ("pcNetCAN (ISA), PhyCAN driver", NONE, NONE),
    ("pcNetCAN (ISA), PCAN 1.x driver", NONE, NONE),
    ("PEAK PCAN-Dongle, PCAN 1.x driver", SOCKETCAN, NONE),
    ("SYS TEC USB-CANmodul, USBCAN 4.x driver", SOCKETCAN, NONE),
    ("PEAK PCAN-PCI, PCAN-PCI driver", SOCKETCAN, PCAN_PCI),
    ("reserved", "", ""),
    ("pcNetCAN (ISA), PCAN 2.x driver", NONE, NONE),
    ("PEAK PCAN-Dongle, PCAN 2.x driver", SOCKETCAN, NONE),
    ("PEAK PCAN-PCI, PCAN 2.x driver", SOCKETCAN, PCAN_PCI),
    ("PEAK PCAN-Dongle, PCAN-Dongle driver", SOCKETCAN, NONE),
    ("PEAK PCAN-USB, PCAN-USB driver", SOCKETCAN, PCAN_USB),
    ("reserved", "", ""),
    ("reserved", "", ""),
    ("SYS TEC CAN-Ethernet gateway", NONE, NONE),
    ("PEAK PCAN-USB, PCAN 2.x driver", SOCKETCAN, PCAN_USB),
    ("CAN over a serial line (VCAN)", "slcan:PORT", "slcan:PORT"),
];

const NONE: &str = "none";
const SOCKETCAN: &str = "socketcan:can0";
const PCAN_USB: &str = "peak:PCAN_USBBUS1@BITRATE";
const PCAN_PCI: &str = "peak:PCAN_PCIBUS1@BITRATE";

impl Legacy {
    /// The list that a question mark asks for. The command then does nothing else.
    pub(super) fn list(&self) -> Option<String> {
        let mut text = String::new();
        if self.vxd_type == Some(Interface::List) {
            text.push_str(
                "vxd_type  interface                                --bus on Linux  --bus on Windows\n",
            );
            for (number, (name, linux, windows)) in (1..).zip(INTERFACES) {
                let line = format!("{number:<8}  {name:<39}  {linux:<14}  {windows}");
                // Writing into memory does not fail.
                let _ = writeln!(text, "{}", line.trim_end());
            }
            text.push_str(
                "none: use an adapter that coflash has (kvaser:, gs_usb:, slcan: and others); coflash adapters lists \
                 those of this computer\n",
            );
        }
        if matches!(self.index, Some(Index::List)) {
            text.push_str("br_idx  bit rate\n");
            for (index, kilobits) in KILOBITS.iter().enumerate() {
                let _ = writeln!(text, "{index:<6}  {kilobits:>4} kbit/s");
            }
        }
        (!text.is_empty()).then_some(text)
    }

    /// Refuses options that this tool cannot support, and warns about options that it ignores.
    pub(super) fn check(&self, context: &Context) -> Result<(), Failure> {
        if self.gateway_id.unwrap_or(0) != 0 || self.network_id.unwrap_or(0) != 0 {
            let what = "an SDO gateway on the CAN bus (CiA 302-7) is not supported";
            let advice = "connect the adapter to the device's own network and leave --gateway_id and --network_id out, \
                          or reach it through a gateway with CiA 309-3: --bus cia309://HOST:PORT/NET";
            return Err(Failure::usage(what, advice));
        }
        // Its device is at another place than any bus of this tool, so none may stand in for it.
        if self.vxd_type == Some(Interface::Type(CAN_ETHERNET)) {
            let what = "the SYS TEC CAN-Ethernet gateway (--vxd_type 14) is not supported: its protocol is not public";
            let advice = "leave --vxd_type, --ip_addr and --ip_port out, and reach the same bus by --bus: \
                          socketcand://HOST:PORT/can0 or slcan:tcp://HOST:PORT (a computer or an adapter at the bus), \
                          or cia309://HOST:PORT/NET (a gateway with CiA 309-3)";
            return Err(Failure::usage(what, advice));
        }
        let serial = self.vxd_type == Some(Interface::Type(VIRTUAL_CAN));
        match self.baudrate {
            Some(rate) if serial && rate != SERIAL_BIT_RATE => {
                let what = format!("a serial line with {rate} bit/s is not supported");
                return Err(Failure::usage(what, format!("its bit rate is {SERIAL_BIT_RATE}")));
            }
            Some(rate) if !serial && !(1..=1000).contains(&rate) => {
                let what = format!("{rate} kbit/s is not a bit rate of a CAN bus");
                let advice = "bit rates are 1 to 1000 kbit/s; a serial line (--vxd_type 16) has 115200 bit/s";
                return Err(Failure::usage(what, advice));
            }
            _ => {}
        }
        if serial && self.bus().is_some() && context.bus.is_none() {
            return Ok(());
        }
        for (name, given) in [
            ("--vxd_type", self.vxd_type.is_some()),
            ("--device_no", self.device_no.is_some()),
            ("--ip_addr", self.ip_addr.is_some()),
            ("--ip_port", self.ip_port.is_some()),
        ] {
            if given {
                context.out.warn(format_args!("{name} is ignored: --bus names the adapter"));
            }
        }
        Ok(())
    }

    /// The URL that these options give without --bus: CAN over the serial port with this number.
    pub(super) fn bus(&self) -> Option<String> {
        let port = self.device_no.filter(|_| self.vxd_type == Some(Interface::Type(VIRTUAL_CAN)))?;
        Some(if cfg!(windows) {
            format!("slcan:COM{port}")
        } else {
            // COM1 is ttyS0.
            format!("slcan:/dev/ttyS{}", port.checked_sub(1)?)
        })
    }

    /// The firmware file.
    pub(super) fn file(&self) -> Option<&Path> {
        self.legacy_file.as_deref()
    }

    /// The node-IDs.
    pub(super) fn nodes(&self) -> Option<&Vec<Vec<NodeId>>> {
        self.node_id.as_ref()
    }

    /// The program number.
    pub(super) fn program(&self) -> Option<u8> {
        self.prog_no
    }

    /// Whether the call is one of DotNetFlashtool. BinaryBlockDownload's -P, -N and -B are this
    /// tool's own options as well.
    fn is_of_dot_net_flashtool(&self) -> bool {
        self.legacy_file.is_some() || self.node_id.is_some() || self.prog_no.is_some()
    }

    /// Whether the words are those of DotNetFlashtool without `--chk_run`: it then releases a program
    /// without a trial, because not every program may be started for a moment (manual L-1112d_10,
    /// note at the end of the steps of a download in chapter 3).
    pub(super) fn makes_no_trial(&self) -> bool {
        self.is_of_dot_net_flashtool() && !self.chk_run
    }

    /// The LSS address, if the user gave any part of it; the other parts have the manual's defaults
    /// (table 9).
    pub(super) fn address(&self) -> Option<LssAddress> {
        let parts = [self.vendor, self.product, self.revision, self.serial];
        parts.iter().any(Option::is_some).then(|| LssAddress {
            vendor_id: self.vendor.unwrap_or(0x3F),
            product_code: self.product.unwrap_or(0),
            revision: self.revision.unwrap_or(0),
            serial_number: self.serial.unwrap_or(0),
        })
    }

    /// Whether the user gave the old spelling of `--check-target`.
    pub(super) fn check_target(&self) -> bool {
        self.chk_tgt.is_some_and(|value| value > 0)
    }

    /// The bit rate in bit/s. The bit rate of a serial line is not a bit rate of the bus.
    pub(super) fn bit_rate(&self) -> Option<u32> {
        let of_bus = self.vxd_type != Some(Interface::Type(VIRTUAL_CAN));
        match (self.baudrate.filter(|_| of_bus), self.index) {
            (Some(kilobits), _) => Some(kilobits * 1000),
            (None, Some(Index::Rate(rate))) => Some(rate),
            (None, Some(Index::List)) => None,
            // Table 11: by default the index is 0.
            (None, None) => (of_bus && self.is_of_dot_net_flashtool()).then_some(KILOBITS[0] * 1000),
        }
    }
}

/// The node-IDs of devices to DotNetFlashtool (table 11), which takes 127 for itself.
fn nodes_of_its_devices(text: &str) -> Result<Vec<NodeId>, String> {
    let nodes = nodes(text)?;
    match nodes.iter().any(|node| node.get() == ITS_OWN_NODE_ID) {
        true => {
            Err("node-IDs are 1 to 126, and 127 is DotNetFlashtool's own: for a device with node-ID 127 \
                     give --node 127"
                .to_string())
        }
        false => Ok(nodes),
    }
}

/// Table 13.
fn index(text: &str) -> Result<Index, String> {
    if text == "?" {
        return Ok(Index::List);
    }
    let kilobits = KILOBITS.get(number(text)? as usize);
    let kilobits = kilobits.ok_or("bit rates are 0 (1 Mbit/s) to 8 (10 kbit/s); ? lists them")?;
    Ok(Index::Rate(kilobits * 1000))
}

/// Table 12.
fn interface(text: &str) -> Result<Interface, String> {
    if text == "?" {
        return Ok(Interface::List);
    }
    match number(text)? {
        kind if (1..=INTERFACES.len() as u32).contains(&kind) => Ok(Interface::Type(kind)),
        _ => Err("interfaces are 1 to 16; ? lists them".to_string()),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        legacy: Legacy,
    }

    fn legacy(words: &[&str]) -> Legacy {
        Line::try_parse_from([&["coflash"], words].concat()).unwrap_or_else(|error| panic!("{error}")).legacy
    }

    /// Chapter 5.3: "the bit rate whose position in the call is the last".
    #[test]
    fn of_two_bit_rates_the_last_one_counts() {
        assert_eq!(legacy(&["--baudrate", "500", "--br_idx", "4"]).bit_rate(), Some(125_000));
        assert_eq!(legacy(&["--br_idx", "4", "--baudrate", "500"]).bit_rate(), Some(500_000));
        assert_eq!(legacy(&[]).bit_rate(), None);
    }

    /// The manual's example: COM7 with 115200 bit/s.
    #[test]
    fn a_serial_line_has_its_own_bit_rate_and_port() {
        let line = legacy(&["--vxd_type", "16", "--baudrate", "115200", "--device_no", "7"]);
        assert_eq!(line.bit_rate(), None);
        let port = if cfg!(windows) { "slcan:COM7" } else { "slcan:/dev/ttyS6" };
        assert_eq!(line.bus().as_deref(), Some(port));
        assert_eq!(legacy(&["--vxd_type", "4", "--device_no", "7"]).bus(), None);
        assert_eq!(legacy(&["--vxd_type", "16", "--device_no", "0"]).bus().is_some(), cfg!(windows));
    }
}
