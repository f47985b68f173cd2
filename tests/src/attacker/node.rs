//! `coboot-node` in virtual time: the firmware's `boot-core` and `canopen` without a chip, and the
//! stand-in for a program. A frame takes its time on the bus; work on the flash takes none. It is
//! some hundred times as fast as the emulator, and its bus has no errors. Any client can use it.

use std::collections::VecDeque;
use std::env;
use std::time::Duration;

use attack::device::Action;
use boot_core::bootloader::{self, entries, entry_count};
use boot_core::control::Policy;
use boot_core::flash::Flash as _;
use boot_core::profile::Profile;
use boot_core::store::NodeParameters;
use bsp::NODE_ID;
use canopen::device::Device as Says;
use canopen::od::Entry;
use canopen::{BitRate, Frame, Instant, NodeId};
use coboot_can::{Adapter, AdapterError};
use coboot_node::device::{self, Setup, BUFFER};
use coboot_node::file_flash::{FileFlash, Speed};
use coboot_node::stand_in::StandIn;
use kit::folder::Folder;
use shared_abi::layout::stm32f407g_disc1_two::LAYOUT;

use super::target::{Event, Happened, Target, OFF_US};

/// A frame with 8 bytes at 125 kbit/s, in us.
const FRAME_US: u64 = 1000;
/// More steps than any work has.
const ENDLESS: u32 = 10_000_000;

/// The device, and its bus.
pub struct Node {
    setup: Setup,
    /// `None` without power.
    device: Option<device::Device<'static, 2>>,
    folder: Folder,
    now_us: u64,
    /// Frames of the masters.
    waiting: VecDeque<Frame>,
    /// The bus is busy until then.
    busy_until: u64,
    events: Vec<Event>,
    /// Steps of work so far.
    steps: u64,
    /// The flash at the last look.
    cells: Vec<u8>,
    /// What the last reset came to.
    pub result: Option<device::Event>,
}

/// The object dictionary of a profile.
fn table(profile: &Profile) -> &'static [Entry] {
    macro_rules! tables {
        ($($profile:ident),*) => {
            $(if profile.extras == Profile::$profile.extras {
                static ENTRIES: [Entry; entry_count(2, Profile::$profile.extras)] =
                    entries(2, Profile::$profile.extras).entries();
                return &ENTRIES;
            })*
        };
    }
    tables!(STANDARD, ESACADEMY, LIFT);
    panic!("a profile without a table")
}

impl Node {
    /// A node with erased flash and this profile, switched on.
    ///
    /// # Panics
    /// If its file cannot be created.
    #[must_use]
    pub fn new(profile: &'static Profile) -> Self {
        let folder = Folder::below(env::temp_dir(), "coboot-attacked");
        let config = Box::leak(Box::new(bootloader::Config {
            entries: table(profile),
            device: Says {
                device_type: profile.device_type,
                name: "coboot-node",
                hardware_version: "none",
                software_version: "coboot",
                heartbeat_ms: 1000,
                vendor_id: bsp::IDENTITY.vendor_id,
                product_code: bsp::IDENTITY.product_code,
                revision: 0x0001_0000,
                serial_number: 0,
            },
            node_id: profile.node_id,
            layout: &LAYOUT,
            supports: coboot_node::supports,
            boot_up_emergency: true,
            download: Policy { ..profile.download },
            password: profile.password,
        }));
        let default =
            profile.default_node.unwrap_or((NodeId::new(NODE_ID).expect("1 to 127"), BitRate::K125));
        let setup = Setup {
            config,
            stand_in: Some(Vec::leak(StandIn::entries(2))),
            refuses: false,
            serial_number: 1,
            node: NodeParameters { id: Some(default.0), bit_rate: default.1 },
            strap: false,
        };
        let mut node = Self {
            setup,
            device: None,
            folder,
            now_us: 0,
            waiting: VecDeque::new(),
            busy_until: 0,
            events: Vec::new(),
            steps: 0,
            cells: Vec::new(),
            result: None,
        };
        node.power_on();
        node
    }

    fn power_on(&mut self) {
        let flash =
            FileFlash::open(&self.folder.join("node.flash"), &LAYOUT, Speed::Instant).expect("a file");
        let (device, event) = device::Device::new(self.setup, flash, vec![0; BUFFER].leak());
        (self.device, self.result) = (Some(device), Some(event));
    }

    fn work(&mut self) {
        let Some(device) = &mut self.device else { return };
        let now = Instant::from_millis((self.now_us / 1000) as u32);
        let (at, events) = (self.now_us, &mut self.events);
        let mut reported = Vec::new();
        for steps in 0.. {
            assert!(steps < ENDLESS, "the work never ends");
            let mut send = |frame| events.push((at, Happened::Frame { by_device: true, frame }));
            let more = device.work(now, &mut send, &mut |event| reported.push(event));
            for event in reported.drain(..) {
                if !matches!(event, device::Event::NodeId(_)) {
                    self.result = Some(event);
                    events.push((at, Happened::Reset));
                }
            }
            if !more.expect("its file can be written") {
                return;
            }
            self.steps += 1;
        }
    }
}

impl Target for Node {
    fn now_us(&self) -> u64 {
        self.now_us
    }

    fn send(&mut self, _master: usize, frame: &Frame) {
        self.waiting.push_back(*frame);
    }

    fn is_drained(&mut self) -> bool {
        self.waiting.is_empty()
    }

    fn pass_us(&mut self, us: u64) {
        let until = self.now_us + us;
        loop {
            if self.busy_until <= self.now_us {
                if let Some(frame) = self.waiting.pop_front() {
                    self.events.push((self.now_us, Happened::Frame { by_device: false, frame }));
                    if let Some(device) = &mut self.device {
                        device.handle(&frame, Instant::from_millis((self.now_us / 1000) as u32));
                    }
                    self.busy_until = self.now_us + FRAME_US;
                }
            }
            self.work();
            if self.now_us >= until {
                return;
            }
            self.now_us = until.min(self.now_us + FRAME_US / 2);
        }
    }

    fn events(&mut self) -> Vec<Event> {
        std::mem::take(&mut self.events)
    }

    fn flash(&mut self) -> &[u8] {
        if let Some(flash) = self.device.as_mut().and_then(device::Device::flash) {
            self.cells.resize(LAYOUT.chip.flash.size as usize, 0xFF);
            flash.read(LAYOUT.chip.flash.base, &mut self.cells);
        }
        &self.cells
    }

    fn flash_activity(&mut self) -> (u64, bool) {
        (self.steps, false)
    }

    /// Its operations take no time, so that nothing can be in the middle of one; and its bus has no
    /// error frames.
    fn act(&mut self, action: &Action) {
        if matches!(action, Action::PowerOff) {
            // Flash does not forget. The file lags by a time of the host's clock, which would make
            // another attack of the same seed on a faster host.
            if let Some(flash) = self.device.as_mut().and_then(device::Device::flash) {
                flash.save().expect("its file can be written");
            }
            self.device = None;
            self.pass_us(OFF_US);
            self.power_on();
        }
    }
}

impl Adapter for Node {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.waiting.push_back(*frame);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now_us + timeout.as_micros() as u64;
        loop {
            let mut events = std::mem::take(&mut self.events).into_iter();
            let sent = events.find_map(|(_, happened)| match happened {
                Happened::Frame { by_device: true, frame } => Some(frame),
                _ => None,
            });
            self.events = events.collect();
            if sent.is_some() || self.now_us >= until {
                return Ok(sent);
            }
            self.pass_us(FRAME_US / 2);
        }
    }

    fn now(&self) -> Duration {
        Duration::from_micros(self.now_us)
    }
}
