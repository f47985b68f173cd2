//! `coboot-node` in virtual time: a device with a stand-in for its program, on its own bus, on
//! which a frame takes no time.

use std::collections::VecDeque;
use std::env;
use std::time::Duration;

use boot_core::bootloader::{self, entries, entry_count, Extras};
use boot_core::profile::Profile;
use boot_core::store::NodeParameters;
use canopen::device::Device as Says;
use canopen::od::Entry;
use canopen::program::BOOTLOADER_DEVICE_TYPE;
use canopen::{BitRate, Frame, Instant, NodeId};
use coboot_can::{Adapter, AdapterError};
use coboot_node::device::{Device, Event, Setup, BUFFER};
use coboot_node::file_flash::{FileFlash, Speed};
use coboot_node::stand_in::StandIn;
use kit::folder::Folder;
use shared_abi::layout::stm32f407g_disc1::LAYOUT;

use crate::bench::NODE;

static ENTRIES: [Entry; entry_count(1, Extras::STANDARD)] = entries(1, Extras::STANDARD).entries();
static CONFIG: bootloader::Config = bootloader::Config {
    entries: &ENTRIES,
    device: Says {
        device_type: BOOTLOADER_DEVICE_TYPE,
        name: "coboot-node",
        hardware_version: "none",
        software_version: "coboot",
        heartbeat_ms: 1000,
        vendor_id: 0,
        product_code: 0,
        revision: 0x0001_0000,
        serial_number: 0,
    },
    node_id: None,
    layout: &LAYOUT,
    supports: coboot_node::supports,
    boot_up_emergency: true,
    download: Profile::STANDARD.download,
    password: &[],
};
/// The time steps.
const STEP: Duration = Duration::from_micros(200);

/// The node and its bus.
pub struct NodeBus {
    device: Device<'static, 1>,
    _folder: Folder,
    now: Duration,
    sent: VecDeque<Frame>,
    /// The results of resets.
    pub events: Vec<Event>,
}

impl NodeBus {
    /// A node with erased flash, in a file of its own.
    ///
    /// # Panics
    /// If the file cannot be created.
    pub fn new(test: &str) -> Self {
        let folder = Folder::below(env::temp_dir(), test);
        let flash = FileFlash::open(&folder.join("node.flash"), &LAYOUT, Speed::Instant).expect("a file");
        let setup = Setup {
            config: &CONFIG,
            stand_in: Some(Vec::leak(StandIn::entries(1))),
            serial_number: 1,
            node: NodeParameters { id: NodeId::new(NODE), bit_rate: BitRate::K125 },
            strap: false,
        };
        let (device, event) = Device::new(setup, flash, vec![0; BUFFER].leak());
        let mut bus =
            Self { device, _folder: folder, now: Duration::ZERO, sent: VecDeque::new(), events: vec![event] };
        // Until its boot-up message.
        bus.run(STEP);
        bus
    }

    /// Runs for this time; frames of the node are dropped.
    ///
    /// # Panics
    /// If its file cannot be written.
    pub fn run(&mut self, time: Duration) {
        let until = self.now + time;
        while self.now < until {
            self.work();
            self.now += STEP;
        }
        self.sent.clear();
    }

    fn instant(&self) -> Instant {
        Instant::from_millis(self.now.as_millis() as u32)
    }

    fn work(&mut self) {
        let (now, sent, events) = (self.instant(), &mut self.sent, &mut self.events);
        for _ in 0..1000 {
            let more =
                self.device.work(now, &mut |frame| sent.push_back(frame), &mut |event| events.push(event));
            if !more.expect("its file can be written") {
                break;
            }
        }
    }
}

impl Adapter for NodeBus {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        let now = self.instant();
        self.device.handle(frame, now);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now + timeout;
        loop {
            self.work();
            if let Some(frame) = self.sent.pop_front() {
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
