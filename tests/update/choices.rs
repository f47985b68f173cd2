//! Our client against our server with each value of a choice that `cargo xtask pairs` varies, in virtual time.
//! The transfers have the frames of CiA 301 clause 7.2.4.3, none of them twice, and nobody waits for a
//! time-out. A service that a product leaves out costs one request.

use std::collections::VecDeque;
use std::time::Duration;

use boot_core::bootloader::{entries, Bootloader, Choices, Config};
use boot_core::control::Step;
use boot_core::store::Journal;
use bsp::{IDENTITY, LAYOUT};
use canopen::device::Device;
use canopen::sdo::server::Config as SdoConfig;
use canopen::slave::{self, Output, Slave};
use canopen::{node, Address, CobId, Frame, Instant};
use coboot_can::{Adapter, AdapterError, SdoIds};
use coflash_core::device::{Session, Timing, Transfers};
use coflash_core::file::checksum::Checksum;
use coflash_core::file::convert::{program_of, Options};
use coflash_core::file::raw;
use coflash_core::file::read::Firmware;
use coflash_core::update::{flash, FlashOptions, Password};
use kit::bench::DEVICE;
use kit::boot::{leaked, Boot};
use kit::model::ModelFlash;
use product::*;
use shared_abi::label::{Label, OFFSET, SIZE};

/// Makes a function of the table of all choices: the default product, and one for each other value of each choice.
macro_rules! choices {
    ($(
        $(#[doc = $about:literal])*
        $group:ident: $type:ty = $default:expr => [$($other:expr),*]
        $(, $(#[$meta:meta])* struct $Group:ident {
            $(
                $(#[doc = $text:literal])*
                $field:ident: $field_type:ty = $field_default:expr => [$($field_other:expr),*];
            )*
        })?
    ;)*) => {
        fn rows() -> Vec<(String, Product)> {
            let mut rows = vec![("the default".to_owned(), Product::DEFAULT)];
            let mut add = |what: &[&str], product| rows.push((what.join(" "), product));
            $(
                $(add(
                    &[stringify!($group), stringify!($other)],
                    Product { $group: $other, ..Product::DEFAULT },
                );)*
                $($($(add(
                    &[stringify!($group), stringify!($field), stringify!($field_other)],
                    Product {
                        $group: $Group { $field: $field_other, ..$Group::DEFAULT }.into(),
                        ..Product::DEFAULT
                    },
                );)*)*)?
            )*
            rows
        }
    };
}

include!("../../bootloader/src/choices.rs");

/// What the code of a bootloader has; for its other choices, its dictionary and its values decide.
struct Blocks<const DOWNLOAD: bool, const UPLOAD: bool>;

impl<const DOWNLOAD: bool, const UPLOAD: bool> Choices for Blocks<DOWNLOAD, UPLOAD> {
    const BLOCK_DOWNLOAD: bool = DOWNLOAD;
    const BLOCK_UPLOAD: bool = UPLOAD;
}

const PROGRAMS: usize = LAYOUT.programs.len();
/// 1008h: four segments, more than a server may send without blocks (the protocol switch threshold of 21).
const NAME: &str = "a device with a long name";
const STEP: Duration = Duration::from_micros(200);

/// What answers at once takes: less than any time-out.
const NO_TIME: Duration = Duration::from_millis(50);

/// SDO frames: of the client, of the server.
type Frames = [u32; 2];

/// A device on its bus, on which a frame takes no time; and the frames of its SDO server.
struct Bus<C: Choices> {
    device: Bootloader<'static, &'static mut ModelFlash, Journal, PROGRAMS, C>,
    slave: Slave,
    ids: [CobId; 2],
    now: Duration,
    sent: VecDeque<Frame>,
    all: Frames,
    /// Those of transfers with 1F50h, and what CiA 301 has for the sizes that the client announced.
    data: Frames,
    expected: Frames,
    /// The segments that the last initiate announced, if it was one of 1F50h.
    announced: Option<u32>,
    is_in_blocks: bool,
    /// Aborts of transfers with 1F50h.
    refused: u32,
    blksize: u32,
}

impl<C: Choices> Bus<C> {
    fn new(product: &Product) -> Self {
        let table = entries::<256>(PROGRAMS as u8, product.extras());
        let config = Config {
            entries: table.parts().to_vec().leak(),
            device: Device {
                device_type: product.profile.device_type,
                name: NAME,
                vendor_id: IDENTITY.vendor_id,
                product_code: IDENTITY.product_code,
                ..DEVICE
            },
            node_id: product.profile.node_id,
            layout: LAYOUT,
            supports: |_| true,
            boot_up_emergency: product.nmt.boot_up_emergency,
            download: product.download_policy(&BOARD, Box::leak(Box::new(renewal(&BOARD)))),
            password: product.profile.password,
        };
        let flash = Box::leak(Box::new(ModelFlash::new(LAYOUT.chip)));
        let journal = Journal::open(flash, LAYOUT.parameters);
        let (buffer, sealed) = leaked(product.download.block_buffer);
        let device = Boot::new(Box::leak(Box::new(config)), kit::bench::node());
        let device = device.with(journal, flash, buffer, sealed);
        let sdo = SdoConfig {
            unknown_request: product.profile.unknown_request,
            request_base: product.sdo.request_base,
            response_base: product.sdo.response_base,
            blksize: product.block_download_or_default().segments_per_sub_block,
            ..SdoConfig::DEFAULT
        };
        let node = node::Config {
            boot_up: product.nmt.boot_up_message,
            heartbeat_ms: product.nmt.heartbeat_ms,
            sdo,
            ..node::Config::default()
        };
        let id = device.node_id().expect("it has one");
        let slave = slave::Config { node, ..slave::Config::default() };
        Self {
            slave: Slave::new(device.lss_address(), Some(id), BitRate::K1000, slave),
            device,
            ids: [sdo.request(id), sdo.response(id)],
            now: Duration::ZERO,
            sent: VecDeque::new(),
            all: [0; 2],
            data: [0; 2],
            expected: [0; 2],
            announced: None,
            is_in_blocks: false,
            refused: 0,
            blksize: product.block_download_or_default().segments_per_sub_block.into(),
        }
    }

    fn instant(&self) -> Instant {
        Instant::from_millis(self.now.as_millis() as u32)
    }

    fn expect(&mut self, client: u32, server: u32) {
        self.expected = [self.expected[0] + client, self.expected[1] + server];
    }

    fn count_request(&mut self, bytes: &[u8; 8]) {
        let is_initiate = matches!(bytes[0] >> 5, 1 | 2 | 5) || bytes[0] & 0xE1 == 0xC0;
        if !self.is_in_blocks && is_initiate {
            let segments = u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]).div_ceil(7);
            self.announced = (bytes[1..3] == [0x50, 0x1F]).then_some(segments);
            match (self.announced, bytes[0]) {
                (Some(segments), 0x21) => self.expect(1 + segments, 1 + segments),
                (Some(_), 0xC6) | (None, _) => {}
                other => panic!("{other:X?}"),
            }
        }
        self.all[0] += 1;
        self.data[0] += u32::from(self.announced.is_some());
    }

    fn count_answer(&mut self, bytes: &[u8; 8]) {
        match (self.announced, bytes[0]) {
            // The initiate, the segments and the end; two answers, and one for each sub-block.
            (Some(segments), 0xA4) if !self.is_in_blocks => {
                self.is_in_blocks = true;
                self.expect(segments + 2, segments.div_ceil(self.blksize) + 2);
            }
            (Some(_), 0x80) => {
                self.refused += 1;
                self.expect(1, 1);
            }
            (_, 0xA1) => self.is_in_blocks = false,
            _ => {}
        }
        self.all[1] += 1;
        self.data[1] += u32::from(self.announced.is_some());
    }
}

impl<C: Choices> Adapter for Bus<C> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        if let Some(bytes) = frame.exactly().filter(|_| frame.has_cob_id(self.ids[0])) {
            self.count_request(bytes);
        }
        let now = self.instant();
        self.slave.handle(frame, now, &mut self.device);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now + timeout;
        loop {
            let now = self.instant();
            self.device.set_time(now);
            (0..1000).take_while(|_| self.device.step() != Step::Idle).count();
            while let Some(output) = self.slave.poll(now, true, &mut self.device) {
                if let Output::Send(frame) = output {
                    self.sent.push_back(frame);
                }
            }
            if let Some(frame) = self.sent.pop_front() {
                if let Some(bytes) = frame.exactly().filter(|_| frame.has_cob_id(self.ids[1])) {
                    self.count_answer(bytes);
                }
                return Ok(Some(frame));
            }
            if self.now >= until {
                return Ok(None);
            }
            self.now += STEP;
        }
    }

    fn now(&self) -> Duration {
        self.now
    }
}

/// Reads and flashes a device of this product; the time of the latter.
fn run<C: Choices>(choices: &str, product: &Product) -> Duration {
    println!("{choices}");
    let timing = Timing::default();
    let mut bus = Bus::<C>::new(product);
    let id = bus.device.node_id().expect("it has one");
    let mut adapter = SdoIds::new(&mut bus, product.sdo.request_base, product.sdo.response_base);
    let mut session = Session::new(&mut adapter, id, timing);
    for index in [0x1000, 0x1008, 0x1008] {
        session.upload(Address::new(index, 0), &mut |_| {}).expect("it can be read");
    }
    // 1000h is expedited. 1008h by blocks: initiate, start, acknowledgement and end; two answers and four
    // segments. In segments: an initiate and four requests, as many answers; and the refused initiate, once.
    assert_eq!(bus.all, if product.sdo.block_upload { [1 + 2 * 4, 1 + 2 * 6] } else { [1 + 1 + 2 * 5; 2] });
    assert!(bus.now < NO_TIME, "read in {:?}", bus.now);

    let base = LAYOUT.programs[0].base;
    let mut image: Vec<u8> = (0..8000_u32).map(|at| (at * 7 + at / 256) as u8).collect();
    image[..8].copy_from_slice(&[[0, 0, 1, 0x20], (base + 0x201).to_le_bytes()].concat());
    let label = Label::new(IDENTITY.vendor_id, IDENTITY.product_code, 1).emit();
    image[OFFSET as usize..][..SIZE].copy_from_slice(&label);
    let checksum = if product.download.crc == CrcKind::Crc16 { Checksum::Crc16 } else { Checksum::Crc32 };
    let image = Firmware::Image(raw::read(&image, Some(base)).expect("an image"));
    let file = program_of(image, &Options::default().checksum(checksum)).expect("a program").program;
    let began = bus.now;
    let mut adapter = SdoIds::new(&mut bus, product.sdo.request_base, product.sdo.response_base);
    let mut session = Session::new(&mut adapter, id, timing);
    // That of the profile of lifts; ESAcademy's is the tool's default.
    let password = product.profile.node_id.and_then(|_| Password::new("coboot"));
    let options = FlashOptions::default().start(false).unlock(password);
    let report = flash(&mut session, &file, &options, &mut |_| {}).expect("an update");
    let form = if product.block_download.is_some() { Transfers::Blocks } else { Transfers::Segments };
    assert_eq!((report.transfers, report.repeats), (form, 0));
    assert_eq!((bus.data, bus.refused), (bus.expected, u32::from(product.block_download.is_none())));
    assert!(bus.data[0] > 8000 / 7, "{:?}", bus.data);
    bus.now - began
}

#[test]
fn the_client_and_the_server_need_no_time_out_with_any_choice() {
    let mut of_default = None;
    let mut products = rows();
    // The other value reads a pin.
    products.retain(|(choices, _)| !choices.contains("programming_allowed"));
    let sdo = Sdo { block_upload: false, ..Sdo::DEFAULT };
    let segments = Product { block_download: None, sdo, ..Product::DEFAULT };
    products.push(("no block transfer".to_owned(), segments));
    for (choices, mut product) in products {
        // How the bootloader renews itself needs a chip.
        product.renewal = None;
        let took = match (product.block_download.is_some(), product.sdo.block_upload) {
            (true, true) => run::<Blocks<true, true>>(&choices, &product),
            (true, false) => run::<Blocks<true, false>>(&choices, &product),
            (false, true) => run::<Blocks<false, true>>(&choices, &product),
            (false, false) => run::<Blocks<false, false>>(&choices, &product),
        };
        let of_default = *of_default.get_or_insert(took);
        // The procedure of a lift has pauses of its own.
        let is_lift = product.profile.node_id.is_some();
        assert!(is_lift || took < of_default + NO_TIME, "{took:?} in place of {of_default:?}");
    }
}
