//! The EDS files (CiA 306-1), which describe a device to a configuration tool.
//!
//! They are made from the tables and the product of the firmware itself (`bootloader/src/product.rs`,
//! built for the host), so they cannot differ from it. Values that every image of a board shares come
//! from its board file. `cargo xtask eds` writes them to `docs/eds/`.

use std::fmt::Write;

use app_template::entries as application;
use boot_core::bootloader::{entries, Extras};
use boot_core::crc::CrcKind;
use bsp::can::BitTiming;
use canopen::device::Device;
use canopen::od::{Access, Address, DataType, DefaultValue, Entry, Kind};
use canopen::program::{region_value, Numbers, IDENTITY, PROGRAM_REGION};
use canopen::BitRate;

use product::{Node, NodeSource, Product};

use crate::products;

/// CiA 306-1 requires dates. The contents have none: the same table gives the same file.
const DATE: &str = "11-21-2026";
const TIME: &str = "12:00AM";

/// The serial number differs between devices.
const SERIAL_NUMBER: Address = Address::new(IDENTITY, 4);
/// The bit rates of an EDS file, in kbit/s (CiA 306-1).
const BIT_RATES: [u32; 8] = [10, 20, 50, 125, 250, 500, 800, 1000];

const PROGRAMS: u8 = bsp::LAYOUT.programs.len() as u8;
/// More entries than any table has.
const MANY: usize = 256;
/// The table of the application.
static APPLICATION: [Entry; application::entry_count(NUMBERS)] = application::entries(NUMBERS).entries();
const NUMBERS: Numbers = application::numbers(bsp::LAYOUT);

/// The product of a bootloader that names none.
const DEFAULT: &str = "default";

/// The description of one image for its EDS file.
pub struct Image {
    /// Name of the file.
    pub file: String,
    /// A description in one line.
    pub description: String,
    /// Its object dictionary.
    pub entries: Vec<Entry>,
    /// Those that PDOs may carry.
    pub mappable: &'static [Entry],
    /// Its device information. The serial number is not used.
    pub device: Device,
    /// Whether node-ID and bit rate can be set over the bus.
    pub lss: bool,
    /// The bit rates at which it can run, in kbit/s.
    pub bit_rates: Vec<u32>,
}

/// The images of `docs/eds/`: the bootloader with each profile and for sealed images, and the
/// application template.
pub fn images() -> Vec<Image> {
    let bootloader = |name, sealed| bootloader_of(name, sealed).expect("a product of the repository");
    vec![
        bootloader(DEFAULT, false),
        bootloader("paulus", false),
        bootloader(DEFAULT, true),
        bootloader("esacademy", false),
        bootloader("lift", false),
        application(),
    ]
}

/// The bootloader of the chosen product (`cargo xtask eds --product`), also for sealed images if it may take
/// them; `None` for the default product, which [`images`] has.
pub fn chosen() -> Option<Vec<Image>> {
    let product = product::PRODUCT;
    let may_seal =
        bsp::LAYOUT.home.is_some() && product.download.crc == CrcKind::Crc32 && !product.ways_in.rom_loader;
    let kinds = if may_seal { &[false, true][..] } else { &[false] };
    (product::NAME != DEFAULT)
        .then(|| kinds.iter().map(|sealed| bootloader(product::NAME, &product, *sealed)).collect())
}

/// The bootloader of the default product.
pub fn default_bootloader() -> Image {
    bootloader_of(DEFAULT, false).expect("a product of the repository")
}

/// The bootloader of a product in `bootloader/products`.
pub fn bootloader_of(name: &str, sealed: bool) -> Option<Image> {
    let (_, product) = products::ALL.iter().find(|(product, _)| *product == name)?;
    Some(bootloader(name, &product.clone().checked(), sealed))
}

/// The bootloader of a product, with the feature `sealed` or without. The tests compare the values with its
/// `main.rs` over the bus.
fn bootloader(name: &str, product: &Product, sealed: bool) -> Image {
    let (mut file, mut description) = ("coboot-bootloader".to_owned(), DESCRIPTION.to_owned());
    let mut software_version = concat!("coboot ", env!("CARGO_PKG_VERSION")).to_owned();
    if sealed {
        file += "-sealed";
        description += ", for sealed images";
    }
    if name != DEFAULT {
        write!(file, "-{name}").expect("a string takes everything");
        write!(description, ", product {name}").expect("a string takes everything");
        write!(software_version, " {name}").expect("a string takes everything");
    }
    let extras = Extras { sealed, ..product.extras() };
    let Node { source, bit_rates, auto_bit_rate, .. } = &product.node;
    let is_fixed = product.lss.is_none() && !auto_bit_rate && !matches!(source, NodeSource::Function(_));
    let own =
        product.profile.default_node.map_or(bsp::BIT_RATE, |(_, rate)| rate.bits_per_second().unwrap_or(0));
    let has = |kbit: &u32| {
        let rate = BitRate::from_bits_per_second(kbit * 1000);
        let is_allowed = rate.is_some_and(|rate| bit_rates.contains(&(rate as u8)));
        is_allowed && can_run_at(kbit * 1000) && (!is_fixed || kbit * 1000 == own)
    };
    Image {
        file: file + ".eds",
        description,
        entries: entries::<MANY>(PROGRAMS, extras).parts().to_vec(),
        mappable: &[],
        device: Device {
            device_type: product.profile.device_type,
            software_version: software_version.leak(),
            heartbeat_ms: product.nmt.heartbeat_ms,
            ..BOARD
        },
        lss: product.lss.is_some(),
        bit_rates: BIT_RATES.into_iter().filter(has).collect(),
    }
}

const DESCRIPTION: &str = "coboot, the CANopen bootloader";

/// The application template, version 1. The tests compare these values with its `objects.rs` over
/// the bus.
pub fn application() -> Image {
    Image {
        file: "coboot-application.eds".to_owned(),
        description: "The application template of coboot".to_owned(),
        entries: APPLICATION.to_vec(),
        mappable: &application::PROCESS,
        device: Device { device_type: 0, software_version: "1.0.0", heartbeat_ms: 500, ..BOARD },
        lss: true,
        bit_rates: BIT_RATES.into_iter().filter(|kbit| can_run_at(kbit * 1000)).collect(),
    }
}

/// Whether the board's CAN controller can run at this bit rate: its own, and those that its clock allows.
fn can_run_at(bit_rate: u32) -> bool {
    bit_rate == bsp::BIT_RATE || BitTiming::new(bsp::CAN_CLOCK, bit_rate).is_some()
}

/// The values of the board file.
const BOARD: Device = Device {
    device_type: 0,
    name: bsp::IDENTITY.device_name,
    hardware_version: bsp::IDENTITY.hardware_version,
    software_version: "",
    heartbeat_ms: 0,
    vendor_id: bsp::IDENTITY.vendor_id,
    product_code: bsp::IDENTITY.product_code,
    revision: bsp::IDENTITY.revision,
    serial_number: 0,
};

impl Image {
    /// The EDS file.
    pub fn eds(&self) -> String {
        let mut eds = Ini(String::new());
        self.about(&mut eds);
        let indices = self.indices();
        let (mandatory, others): (Vec<u16>, Vec<u16>) =
            indices.iter().partition(|index| matches!(index, 0x1000 | 0x1001 | 0x1018));
        let (manufacturer, optional): (Vec<u16>, Vec<u16>) =
            others.iter().partition(|index| matches!(index, 0x2000..=0x5FFF));
        for (list, of) in [
            ("MandatoryObjects", mandatory),
            ("OptionalObjects", optional),
            ("ManufacturerObjects", manufacturer),
        ] {
            eds.section(list);
            eds.line("SupportedObjects", of.len());
            for (i, index) in of.iter().enumerate() {
                eds.line(i + 1, format_args!("0x{index:04X}"));
            }
            for index in &of {
                self.object(&mut eds, *index);
            }
        }
        eds.0
    }

    /// The indices of all objects, ascending.
    pub fn indices(&self) -> Vec<u16> {
        let mut indices: Vec<u16> = self.entries.iter().map(|entry| entry.at.index).collect();
        indices.sort_unstable();
        indices.dedup();
        indices
    }

    /// The sections before the objects.
    fn about(&self, eds: &mut Ini) {
        eds.section("FileInfo");
        eds.line("FileName", &self.file);
        eds.line("FileVersion", 1);
        eds.line("FileRevision", 0);
        eds.line("EDSVersion", "4.0");
        eds.line("Description", &self.description);
        for what in ["Creation", "Modification"] {
            eds.line(format_args!("{what}Time"), TIME);
            eds.line(format_args!("{what}Date"), DATE);
        }
        eds.line("CreatedBy", "cargo xtask eds");
        eds.line("ModifiedBy", "cargo xtask eds");

        eds.section("DeviceInfo");
        eds.line("VendorName", "coboot");
        eds.line("VendorNumber", format_args!("0x{:08X}", self.device.vendor_id));
        eds.line("ProductName", self.device.name);
        eds.line("ProductNumber", format_args!("0x{:08X}", self.device.product_code));
        eds.line("RevisionNumber", format_args!("0x{:08X}", self.device.revision));
        eds.line("OrderCode", "");
        for kbit in BIT_RATES {
            eds.line(format_args!("BaudRate_{kbit}"), u8::from(self.bit_rates.contains(&kbit)));
        }
        eds.line("SimpleBootUpMaster", 0);
        eds.line("SimpleBootUpSlave", 1);
        // Whole bytes can be mapped; 0 is for a device without PDOs.
        eds.line("Granularity", if self.mappable.is_empty() { 0 } else { 8 });
        eds.line("DynamicChannelsSupported", 0);
        eds.line("GroupMessaging", 0);
        for (key, parameters) in [("NrOfRxPDO", 0x1400..0x1600), ("NrOfTxPDO", 0x1800..0x1A00)] {
            let pdos = self.indices().into_iter().filter(|index| parameters.contains(index));
            eds.line(key, pdos.count());
        }
        eds.line("LSS_Supported", u8::from(self.lss));
        eds.line("CompactPDO", 0);

        eds.section("DummyUsage");
        for data_type in 1..=7 {
            eds.line(format_args!("Dummy{data_type:04X}"), 0);
        }

        eds.section("Comments");
        eds.line("Lines", 2);
        eds.line("Line1", format_args!("{}, on the board {}.", self.description, bsp::LAYOUT.board));
        eds.line("Line2", "Made from the table that the firmware serves; change that, not this.");
    }

    /// An object and its parts.
    fn object(&self, eds: &mut Ini, index: u16) {
        for entry in self.entries.iter().filter(|entry| entry.at.index == index) {
            let (object_type, parts) = match entry.kind {
                Kind::Var => {
                    eds.section(format_args!("{index:04X}"));
                    self.value(eds, entry, entry.name);
                    continue;
                }
                Kind::Sub => {
                    eds.section(format_args!("{index:04X}sub{:X}", entry.at.sub));
                    self.value(eds, entry, entry.name);
                    continue;
                }
                Kind::Array(_) => (ARRAY, self.parts(index)),
                Kind::Record(_) => (RECORD, self.parts(index)),
            };
            eds.section(format_args!("{index:04X}"));
            eds.line("ParameterName", entry.name);
            eds.line("ObjectType", format_args!("0x{object_type:X}"));
            eds.line("SubNumber", parts);
            eds.section(format_args!("{index:04X}sub0"));
            // For a writable head, the value is the number of used entries (1003h).
            let name = match entry.access {
                Access::Const => "Highest sub-index supported",
                _ => "Number of entries",
            };
            self.value(eds, entry, name);
        }
    }

    /// The number of sub-indices of an object, including 0.
    fn parts(&self, index: u16) -> usize {
        self.entries.iter().filter(|entry| entry.at.index == index).count()
    }

    fn value(&self, eds: &mut Ini, entry: &Entry, name: &str) {
        let object_type = if entry.data_type == DataType::Domain { DOMAIN } else { VAR };
        eds.line("ParameterName", name);
        eds.line("ObjectType", format_args!("0x{object_type:X}"));
        eds.line("DataType", format_args!("0x{:04X}", entry.data_type as u8));
        eds.line("AccessType", access(entry.access));
        if let Some(value) = self.default(entry) {
            eds.line("DefaultValue", value);
        }
        let is_mappable = self.mappable.iter().any(|mappable| mappable.at == entry.at);
        eds.line("PDOMapping", u8::from(is_mappable));
    }

    /// The value that a device returns before the first write: from the table, from the head
    /// itself, or from the device information.
    fn default(&self, entry: &Entry) -> Option<String> {
        match (entry.default, entry.kind) {
            (DefaultValue::Number(value), _) => return Some(number(entry.data_type, value)),
            (DefaultValue::Text(text), _) => return Some(text.to_owned()),
            (DefaultValue::None, Kind::Array(highest) | Kind::Record(highest)) => {
                return Some(number(entry.data_type, highest.into()));
            }
            (DefaultValue::None, _) if entry.at == SERIAL_NUMBER => return None,
            (DefaultValue::None, Kind::Sub) if entry.at.index == PROGRAM_REGION => {
                let region = bsp::LAYOUT.program(entry.at.sub)?;
                let value = u64::from_le_bytes(region_value(region.base, region.size));
                return Some(number(entry.data_type, value));
            }
            _ => {}
        }
        let mut buf = [0; canopen::sdo::server::VALUE_MAX];
        let len = self.device.read(entry.at, &mut buf)?.expect("what a device says of itself can be read");
        Some(match entry.data_type {
            DataType::VisibleString => String::from_utf8_lossy(&buf[..len]).into_owned(),
            data_type => {
                number(data_type, buf[..len].iter().rfold(0, |value, byte| value << 8 | u64::from(*byte)))
            }
        })
    }
}

// Object codes of CiA 301 table 42.
const DOMAIN: u8 = 2;
const VAR: u8 = 7;
const ARRAY: u8 = 8;
const RECORD: u8 = 9;

fn access(access: Access) -> &'static str {
    match access {
        Access::Const => "const",
        Access::Ro => "ro",
        Access::Wo => "wo",
        Access::Rw => "rw",
    }
}

/// Hexadecimal for values that are read bit by bit or digit by digit, with all digits of their
/// type.
fn number(data_type: DataType, value: u64) -> String {
    match data_type {
        DataType::Unsigned32 => format!("0x{value:08X}"),
        DataType::Unsigned64 => format!("0x{value:016X}"),
        _ => value.to_string(),
    }
}

/// The contents of the file so far.
struct Ini(String);

impl Ini {
    fn section(&mut self, name: impl std::fmt::Display) {
        if !self.0.is_empty() {
            self.0.push('\n');
        }
        writeln!(self.0, "[{name}]").expect("a string takes everything");
    }

    fn line(&mut self, key: impl std::fmt::Display, value: impl std::fmt::Display) {
        writeln!(self.0, "{key}={value}").expect("a string takes everything");
    }
}
