//! The renewal of the bootloader, on the model of the flash, with the power cut at every operation.

use std::sync::LazyLock;

use boot_core::bootloader::{entries, entry_count, Bootloader, Choices, Config, Extras};
use boot_core::control::{Policy, Step};
use boot_core::crc::CrcKind;
use boot_core::flash::FlashFault;
use boot_core::program::verify;
use boot_core::store::{Journal, RenewalRecord};
use canopen::od::{Address, Entry, Objects};
use canopen::{AbortCode, Instant};
use kit::bench::{self, block_file_at, node, program, CLEAR, DEVICE, START};
use kit::bench::{CLR_SIGNATURE as WITHDRAW, SET_SIGNATURE as CONFIRM};
use kit::boot::{leaked, Boot};
use kit::ihex;
use kit::model::{until_power_cut, Cut, ModelFlash, CHIP};
use kit::renewal::{
    crc_of, image, image_of, loads, BOARD, HOME, HOST, LAYOUT, PROGRAM, RENEWAL, SOUND, STAGING,
};
use kit::rig::{go_on, Rig, RENEWALS};
use shared_abi::abilities::Abilities;
use shared_abi::boot_report::BootReport;
use shared_abi::geometry::Region;
use shared_abi::ram_image::{Header, SERVICES_VERSION};
use shared_abi::renewal::{word, Origin, Progress, State, TrialEnd};
use shared_abi::warm_start::{BootRequest, TrialStep};

const N: u8 = 2;
const EXTRAS: Extras = Extras { bootloader: Some(N), ..Extras::STANDARD };
static ENTRIES: [Entry; entry_count(1, EXTRAS)] = entries(1, EXTRAS).entries();
static CONFIG: Config = Config {
    entries: &ENTRIES,
    device: DEVICE,
    layout: &LAYOUT,
    download: Policy { renewal: Some(&RENEWAL), ..Policy::DEFAULT },
    ..bench::CONFIG
};

/// A device with renewal.
struct Renews;

impl Choices for Renews {
    const EXTRAS: Extras = EXTRAS;
}

const BUSY: u32 = 0x86;
const NOT_CLEARED: u32 = 0x08;
const FORMAT: u32 = 0x04;
const NO_VALID_PROGRAM: u32 = 0x02;
const WRITE: u32 = 0x0A;
const SECURED: u32 = 0x0E;

/// The image at home, and the one that takes its place.
static OLD: LazyLock<Vec<u8>> = LazyLock::new(|| image(0x200, 1));
static NEW: LazyLock<Vec<u8>> = LazyLock::new(|| image(0x300, 2));

/// What remains of a device when its power is off: the flash. And what a warm reset keeps.
struct Board {
    flash: ModelFlash,
    request: Option<BootRequest>,
}

impl Board {
    /// A device with the first image at home, and a program that does not reach into staging.
    fn new(first: &[u8]) -> Self {
        let mut flash = ModelFlash::new(&CHIP);
        flash.poke(HOME.base, first);
        let mut board = Self { flash, request: None };
        board.install_program(0x1000);
        board.off();
        board
    }

    /// A device that was switched on after an image was staged.
    fn with_staged(old: &[u8], new: &[u8]) -> Self {
        let mut board = Self::new(old);
        board.start().stage(new);
        board.off();
        board
    }

    /// A device that runs this image on trial at its next start.
    fn on_trial(old: &[u8], new: &[u8]) -> Self {
        let mut board = Self::with_staged(old, new);
        board.leave(Some(BootRequest::Renewal(TrialStep::Try)));
        board
    }

    fn install_program(&mut self, size: usize) {
        let mut node = self.start();
        node.download(size);
        assert_eq!(node.command(1, CONFIRM), 0);
        self.leave(None);
    }

    fn off(&mut self) {
        self.flash.power_on();
        self.request = None;
    }

    /// A warm reset with this request.
    fn leave(&mut self, request: Option<BootRequest>) {
        self.request = request;
    }

    /// The image that the resident part loads.
    fn loads(&self) -> (Header, Origin, TrialEnd) {
        loads(&self.flash, &LAYOUT, HOST, self.request).expect("no bootloader can be loaded")
    }

    fn start(&mut self) -> Node<'_> {
        let mut node = self.wake();
        node.settle();
        node
    }

    /// The bootloader has come up, and has done nothing yet.
    fn wake(&mut self) -> Node<'_> {
        let (_, origin, trial_end) = self.loads();
        self.wake_as(origin, trial_end)
    }

    /// The same, as this image.
    fn wake_as(&mut self, origin: Origin, trial_end: TrialEnd) -> Node<'_> {
        self.request = None;
        let report = BootReport { renewal: word(origin, trial_end), ..BootReport::NONE };
        let journal = Journal::open(&self.flash, LAYOUT.parameters);
        let (buffer, sealed) = leaked(512);
        let boot = Boot { report, ..Boot::new(&CONFIG, node()) };
        Node(boot.with(journal, &mut self.flash, buffer, sealed))
    }

    /// What a tool does until the new image is installed, from whatever state.
    fn renew(&mut self, new: &[u8]) {
        for _ in 0..8 {
            let mut node = self.start();
            let Progress { state, origin, .. } = node.progress();
            match (state, origin) {
                (State::Staged, Origin::Trial) => {
                    assert_eq!(node.command(N, CONFIRM), 0);
                    assert_eq!(node.progress().state, State::Installed);
                    return;
                }
                (State::Staged, _) if node.word(0x1F56) != crc_of(new) || !node.has_staged(new) => {
                    node.stage(new);
                }
                (State::Staged, _) => {
                    assert_eq!(node.command(N, START), 0);
                    let request = node.0.take_boot_request();
                    assert_eq!(request, Some(BootRequest::Renewal(TrialStep::Try)));
                    self.leave(request);
                    continue;
                }
                (State::Installed, Origin::Home) if node.word(0x1F56) == crc_of(new) => return,
                _ => node.stage(new),
            }
            let request = {
                assert_eq!(node.command(N, START), 0);
                node.0.take_boot_request()
            };
            self.leave(request);
        }
        panic!("the renewal does not end");
    }

    /// What holds at any time: a bootloader can be loaded, and the program is there.
    fn check(&self, images: [&[u8]; 2]) {
        let (loaded, ..) = self.loads();
        assert!(images.iter().any(|image| crc_of(image) == loaded.crc), "an image of nobody");
        let journal = Journal::open(&self.flash, LAYOUT.parameters);
        assert!(verify(&self.flash, &journal, &LAYOUT, CrcKind::Crc32, 1).unwrap().signed);
    }
}

fn program_of(size: usize) -> Vec<u8> {
    let mut image = program(size, 0x5A);
    image[4..8].copy_from_slice(&(PROGRAM.base + 0x101).to_le_bytes());
    image
}

/// A running bootloader.
struct Node<'f>(Bootloader<'static, &'f mut ModelFlash, Journal, 2, Renews>);

impl Node<'_> {
    fn settle(&mut self) {
        assert!((0..1_000_000).any(|_| self.0.step() == Step::Idle), "the work does not end");
    }

    fn read<const LEN: usize>(&mut self, index: u16, sub: u8) -> [u8; LEN] {
        let mut bytes = [0; LEN];
        assert_eq!(self.0.read(Address::new(index, sub), &mut bytes), Ok(LEN));
        bytes
    }

    /// A word of the bootloader's own program number.
    fn word(&mut self, index: u16) -> u32 {
        u32::from_le_bytes(self.read(index, N))
    }

    fn progress(&mut self) -> Progress {
        Progress::from_bytes(self.read(0x2007, 9)).unwrap()
    }

    fn try_command(&mut self, program: u8, command: u8) -> Result<(), AbortCode> {
        self.0.write(Address::new(0x1F51, program), &[command])
    }

    /// Carries out a command; its status.
    fn command(&mut self, program: u8, command: u8) -> u32 {
        self.try_command(program, command).unwrap();
        self.settle();
        self.status(program)
    }

    fn status(&mut self, program: u8) -> u32 {
        u32::from_le_bytes(self.read(0x1F57, program))
    }

    /// CLEAR, and a program of this size in block files.
    fn download(&mut self, size: usize) {
        assert_eq!(self.command(1, CLEAR), 0);
        self.send_all(1, block_file_at(&program_of(size), PROGRAM.base, 200));
    }

    fn send_all<B: AsRef<[u8]>>(&mut self, program: u8, blocks: impl IntoIterator<Item = B>) {
        blocks.into_iter().for_each(|block| self.send(program, block.as_ref()).unwrap());
    }

    fn send(&mut self, program: u8, block: &[u8]) -> Result<(), AbortCode> {
        self.push(program, block)?;
        self.settle();
        Ok(())
    }

    /// Sends a block, and does not wait until it is written.
    fn push(&mut self, program: u8, block: &[u8]) -> Result<(), AbortCode> {
        let at = Address::new(0x1F50, program);
        self.0.download_start(at, Some(block.len() as u32))?;
        go_on(&mut self.0, program, block, 7)?;
        self.0.download_end(at)
    }

    /// Downloads an image in block files.
    fn stage(&mut self, new: &[u8]) {
        assert_eq!(self.command(N, CLEAR), 0);
        for block in block_file_at(new, HOME.base, 200) {
            assert_eq!((self.send(N, &block), self.word(0x1F57)), (Ok(()), 0));
        }
        assert_eq!(self.progress().state, State::Staged);
    }

    fn has_staged(&mut self, new: &[u8]) -> bool {
        self.0.flash().cells(STAGING)[..new.len()] == *new
    }
}

#[test]
fn an_image_is_staged_tried_confirmed_and_installed() {
    // For the revision of the device alone.
    let newer = Header { version: 0x0001_0003, revisions: 1 << 3, ..SOUND };
    let (old, new) = (image(0x200, 1), image_of(newer, 0x300, 2, true));
    let mut board = Board::new(&old);
    let program = board.flash.cells(PROGRAM)[..0x1000].to_vec();
    let mut node = board.start();
    assert_eq!(node.read(0x2007, 1), [N]);
    assert_eq!(node.read(0x1F51, N), [1], "it runs");
    let places = [HOME.base, HOME.size].map(u32::to_le_bytes).concat();
    assert_eq!(node.read::<8>(0x2004, N).to_vec(), places);
    assert_eq!(node.read::<8>(0x2007, 8).to_vec(), [0x0001_0002, 2_u32].map(u32::to_le_bytes).concat());
    assert_eq!((node.progress(), node.word(0x1F56)), (Progress::default(), crc_of(&old)));
    assert_eq!(node.word(0x2005), SOUND.version);
    assert_eq!(node.command(N, START), NO_VALID_PROGRAM, "nothing is staged");
    assert_eq!(node.command(N, CONFIRM), 0, "and nothing to confirm");
    node.stage(&new);
    assert_eq!((node.word(0x1F56), node.word(0x2005)), (crc_of(&new), newer.version));
    assert_eq!(node.command(N, CONFIRM), 0, "before its trial this changes nothing");
    assert_eq!(node.progress(), Progress { state: State::Staged, ..Progress::default() });
    assert_eq!(node.command(N, START), 0);
    assert_eq!(node.0.take_boot_request(), Some(BootRequest::Renewal(TrialStep::Try)));
    board.leave(Some(BootRequest::Renewal(TrialStep::Try)));
    assert_eq!(board.loads().0.crc, crc_of(&new));
    let mut node = board.start();
    let trial = Progress { state: State::Staged, origin: Origin::Trial, ..Progress::default() };
    assert_eq!((node.progress(), node.word(0x1F56)), (trial, crc_of(&new)));
    assert_eq!(node.word(0x2005), newer.version);
    assert_eq!(node.try_command(N, START), Err(AbortCode::DEVICE_STATE), "one trial at a time");
    assert_eq!(node.command(N, CONFIRM), 0);
    assert_eq!(node.progress().state, State::Installed);
    assert_eq!(node.command(N, CONFIRM), 0, "twice");
    assert_eq!(board.flash.cells(HOME)[..new.len()], new);
    assert_eq!(board.flash.cells(PROGRAM)[..0x1000], program);
    board.off();
    let mut node = board.start();
    assert_eq!(node.progress(), Progress { state: State::Installed, ..Progress::default() });
    assert_eq!(board.loads().1, Origin::Home);
    board.check([&new, &new]);
}

/// Each form in which 1F50h takes a program.
#[test]
fn every_format_is_taken() {
    for form in ["raw", "hex"] {
        let mut board = Board::new(&OLD);
        let mut node = board.start();
        let bytes = if form == "raw" { NEW.clone() } else { ihex::intel_hex(HOME.base, &NEW).into_bytes() };
        // As for a program: what has broken off begins anew after STOP.
        let at = Address::new(0x1F50, N);
        node.0.download_start(at, None).unwrap();
        go_on(&mut node.0, N, &bytes[..0x300], 7).unwrap();
        node.0.download_cancel(at);
        assert_eq!(node.send(N, &bytes), Err(AbortCode::DEVICE_STATE), "{form}");
        node.command(N, 0);
        node.send(N, &bytes).unwrap();
        assert_eq!((node.word(0x1F57), node.progress().state), (0, State::Staged), "{form}");
        assert!(node.has_staged(&NEW), "{form}");
    }
}

#[test]
fn a_trial_ends_without_anybody_there() {
    let mut board = Board::new(&OLD);
    board.start().stage(&NEW);
    for (ends, end) in
        [(None, TrialEnd::Late), (Some(WITHDRAW), TrialEnd::GivenUp), (Some(CLEAR), TrialEnd::GivenUp)]
    {
        board.leave(Some(BootRequest::Renewal(TrialStep::Try)));
        let mut node = board.start();
        let request = match ends {
            Some(command) => {
                assert_eq!(node.command(N, command), 0);
                node.0.take_boot_request()
            }
            None => {
                node.0.set_time(Instant::from_millis(59_999));
                assert_eq!(node.0.take_boot_request(), None);
                node.0.set_time(Instant::from_millis(60_000));
                node.0.take_boot_request()
            }
        };
        board.leave(request);
        assert_eq!(board.loads().0.crc, crc_of(&OLD));
        let mut node = board.start();
        let over = Progress { state: State::Staged, origin: Origin::Home, trial_end: end };
        assert_eq!(node.progress(), over);
        node.0.set_time(Instant::from_millis(100_000));
        assert_eq!(node.0.take_boot_request(), None, "it stays");
    }
    // A power cut in a trial.
    board.leave(Some(BootRequest::Renewal(TrialStep::Try)));
    board.start();
    board.off();
    assert_eq!(board.loads().1, Origin::Home);
    // A confirmed one stays.
    board.leave(Some(BootRequest::Renewal(TrialStep::Try)));
    let mut node = board.start();
    assert_eq!(node.command(N, CONFIRM), 0);
    node.0.set_time(Instant::from_millis(100_000));
    assert_eq!(node.0.take_boot_request(), None);
}

/// "Refused before an erase": staging keeps the image that is there.
#[test]
fn what_cannot_become_the_bootloader_is_refused_before_an_erase() {
    let (old, spare) = (image(0x200, 1), image(0x300, 2));
    let mut board = Board::new(&old);
    board.start().stage(&spare);
    for (case, header, has_crc) in [
        ("for the bench", SOUND, false),
        ("for another board", Header { board: !BOARD, ..SOUND }, true),
        ("for newer services", Header { services: SERVICES_VERSION + 1, ..SOUND }, true),
        ("with an unknown ability", Header { features: Abilities(2 | 1 << 7), ..SOUND }, true),
        ("without renewal", Header { features: Abilities::NONE, ..SOUND }, true),
        ("for another place in RAM", Header { ram_base: 0x2000_0200, ..SOUND }, true),
        ("of another format", Header { length: 64 | 1 << 16, ..SOUND }, true),
    ] {
        let wrong = image_of(header, 0x280, 3, has_crc);
        for bytes in [block_file_at(&wrong, HOME.base, 200)[1].clone(), wrong.clone()] {
            let mut node = board.start();
            assert_eq!(node.command(N, CLEAR), 0);
            if bytes.len() < wrong.len() {
                node.send(N, &block_file_at(&wrong, HOME.base, 200)[0]).unwrap();
            }
            let refused = node.send(N, &bytes);
            node.settle();
            assert!(refused.is_err() || node.word(0x1F57) == FORMAT, "{case}");
            assert_eq!(node.word(0x1F57), FORMAT, "{case}");
            assert!(node.has_staged(&spare), "{case}");
            assert_eq!(node.progress().state, State::Staged, "{case}");
            board.leave(None);
        }
    }
    // Of another vendor, another product; for another resident part, with the detail that says so.
    for (header, status) in [
        (Header { facts: 1, ..SOUND }, 6 << 16 | FORMAT),
        (Header { vendor: 9, ..SOUND }, 0x80),
        (Header { product: 9, ..SOUND }, 0x82),
        // All revisions but the one of the device.
        (Header { revisions: !(1 << 3), ..SOUND }, 0x82),
    ] {
        let mut node = board.start();
        let _ = node.send(N, &image_of(header, 0x280, 3, true));
        node.settle();
        assert_eq!((node.word(0x1F57), node.has_staged(&spare)), (status, true));
        board.leave(None);
    }
    // Write protection of home, and of staging.
    for sector in [4, 11] {
        board.flash.protected = vec![sector];
        let mut node = board.start();
        assert_eq!(node.command(N, CLEAR), 0);
        assert_eq!(node.send(N, &spare), Err(AbortCode::DEVICE_STATE));
        assert_eq!(node.word(0x1F57), SECURED | u32::from(sector) << 16);
        board.leave(None);
    }
}

#[test]
fn a_damaged_image_is_not_staged() {
    let (old, mut new) = (image(0x200, 1), image(0x300, 2));
    new[0x200] ^= 4;
    let mut board = Board::new(&old);
    let mut node = board.start();
    let _ = node.send(N, &new);
    assert_eq!((node.word(0x1F57), node.progress().state), (NO_VALID_PROGRAM, State::None));
    assert_eq!(node.command(N, START), NO_VALID_PROGRAM);
    assert_eq!(node.0.take_boot_request(), None);
}

/// A program takes the flash of the image on trial: that can no longer be confirmed, and ends as well.
#[test]
fn a_trial_without_its_image_ends_too() {
    let mut board = Board::on_trial(&OLD, &NEW);
    let mut node = board.start();
    node.download(0x3400);
    assert_eq!((node.progress().state, node.progress().origin), (State::None, Origin::Trial));
    // Bits 1 to 7 of 1F57h: 1, no valid program (CiA 302-3).
    assert_eq!(node.command(N, CONFIRM), 1 << 1);
    node.0.set_time(Instant::from_millis(59_999));
    assert_eq!(node.0.take_boot_request(), None);
    node.0.set_time(Instant::from_millis(60_000));
    assert_eq!(node.0.take_boot_request(), Some(BootRequest::Renewal(TrialStep::Late)));
}

/// An image that was installed is on trial no more, whatever becomes of its record.
#[test]
fn a_program_that_takes_the_spare_does_not_end_the_image_that_was_installed() {
    let mut board = Board::on_trial(&OLD, &NEW);
    let mut node = board.start();
    assert_eq!((node.command(N, CONFIRM), node.progress().state), (0, State::Installed));
    node.download(0x3400);
    assert_eq!(node.progress().state, State::None);
    node.0.set_time(Instant::from_millis(200_000));
    assert_eq!((node.command(N, CLEAR), node.0.take_boot_request()), (0, None));
}

/// 83h in the last millisecond counts, also if its store takes longer.
#[test]
fn a_confirmation_just_in_time_is_not_thrown_away() {
    for steps in [0, 1, 4, 12, 40] {
        let mut board = Board::on_trial(&OLD, &NEW);
        let mut node = board.start();
        node.0.set_time(Instant::from_millis(59_999));
        node.try_command(N, CONFIRM).unwrap();
        for _ in 0..steps {
            node.0.step();
        }
        node.0.set_time(Instant::from_millis(60_000));
        while node.progress().state != State::Installed {
            assert!(node.0.is_finishing(), "{steps}: a reset would begin it anew");
            assert_ne!(node.0.step(), Step::Idle, "{steps}");
        }
        node.settle();
        assert_eq!(node.0.take_boot_request(), None, "{steps}");
    }
}

/// A program's download that is complete is no reason to refuse a trial; one that is open is.
#[test]
fn a_complete_download_of_a_program_does_not_keep_a_trial_away() {
    let mut board = Board::with_staged(&OLD, &NEW);
    let mut node = board.start();
    assert_eq!(node.command(1, CLEAR), 0);
    let file = block_file_at(&program_of(0x1000), PROGRAM.base, 200);
    let (last, first) = file.split_last().unwrap();
    node.send_all(1, first);
    assert_eq!(node.try_command(N, START), Err(AbortCode::DEVICE_STATE));
    assert_eq!(node.word(0x1F57), BUSY);
    node.send(1, last).unwrap();
    // A transfer that has brought nothing yet is one that is open.
    let at = Address::new(0x1F50, 1);
    node.0.download_start(at, None).unwrap();
    assert_eq!(node.try_command(N, START), Err(AbortCode::DEVICE_STATE));
    node.0.download_cancel(at);
    assert_eq!(node.command(N, START), 0);
    assert_eq!(node.0.take_boot_request(), Some(BootRequest::Renewal(TrialStep::Try)));
}

/// The record of staging cannot be removed, and a program has to leave its flash alone: the error is the program's.
#[test]
fn a_program_whose_way_into_staging_cannot_be_stored_is_told() {
    let mut board = Board::with_staged(&OLD, &NEW);
    let mut node = board.start();
    assert_eq!(node.command(1, CLEAR), 0);
    let file = block_file_at(&program_of(0x3400), PROGRAM.base, 200);
    let reaches = (STAGING.base - PROGRAM.base) as usize / 200;
    node.send_all(1, &file[..reaches]);
    // Both sectors of the journal.
    node.0.flash().protected = vec![1, 2];
    for block in &file[reaches..reaches + 3] {
        let _ = node.push(1, block);
        node.settle();
    }
    assert_ne!(node.status(1) >> 1 & 0x7F, 0, "an error of the program");
    assert!(node.has_staged(&NEW) && node.progress().state == State::Staged);
}

/// A download of the program that has passed the start of staging does not go on over a new image.
#[test]
fn an_open_download_that_reaches_into_staging_is_dropped_with_the_new_image() {
    let mut board = Board::new(&OLD);
    let mut node = board.start();
    assert_eq!(node.command(1, CLEAR), 0);
    let mut file = block_file_at(&program_of(0x3700), PROGRAM.base, 200);
    // With a size: it could go on.
    file[0] = bench::block(0, 0, &[0x3700_u32, 0, 0].map(u32::to_le_bytes).concat());
    node.send_all(1, &file[..file.len() - 5]);
    // An image that is refused takes nothing from it.
    let wrong = image_of(Header { board: !BOARD, ..SOUND }, 0x280, 3, true);
    let _ = node.send(N, &wrong);
    assert_eq!(node.word(0x1F57), FORMAT);
    board.off();
    let mut node = board.start();
    let partial: [u8; 8] = node.read(0x2006, 1);
    let end = u32::from_le_bytes(partial[4..].try_into().unwrap());
    assert!(end > STAGING.base, "{end:08X}h is before staging: the next download would not be dropped");
    node.stage(&NEW);
    board.off();
    let mut node = board.start();
    assert_eq!((node.read::<8>(0x2006, 1), node.progress().state), ([0; 8], State::Staged));
}

/// The last program and staging share a sector.
#[test]
fn a_program_that_reaches_into_staging_takes_it() {
    let large = program_of(0x3400);
    for state in [State::Staged, State::Installed] {
        let mut board = Board::new(&OLD);
        match state {
            State::Staged => board.start().stage(&NEW),
            _ => board.renew(&NEW),
        }
        board.off();
        let mut node = board.start();
        assert_eq!(node.command(1, CLEAR), 0);
        assert_eq!(node.progress().state, state, "CLEAR alone changes nothing");
        let file = block_file_at(&large, PROGRAM.base, 200);
        let mut removed_at = None;
        for (number, block) in file.iter().enumerate() {
            node.send(1, block).unwrap();
            let is_there = node.has_staged(&NEW);
            let record = node.progress().state;
            assert!(is_there || record == State::None, "{state:?}: block {number}");
            if record == State::None {
                removed_at.get_or_insert(number);
            }
        }
        assert!(removed_at.is_some());
        assert_eq!(node.status(1), 0);
        assert_eq!(node.command(1, CONFIRM), 0);
        // Now there is no room for an image.
        assert_eq!(node.command(N, CLEAR), 0);
        let first = &block_file_at(&NEW, HOME.base, 200)[0];
        assert_eq!(node.send(N, first), Err(AbortCode::DEVICE_STATE));
        assert_eq!(node.word(0x1F57), NOT_CLEARED | 1 << 16);
        assert_eq!(node.command(1, CLEAR), 0);
        assert_eq!(node.command(1, CLEAR), 0, "all of it");
        node.stage(&NEW);
    }
}

/// A small program leaves a spare alone, also one that ends where staging begins.
#[test]
fn a_program_that_ends_before_staging_leaves_it_alone() {
    for size in [0x1800, STAGING.base - PROGRAM.base] {
        let mut board = Board::new(&OLD);
        board.renew(&NEW);
        board.off();
        board.install_program(size as usize);
        let mut node = board.start();
        assert_eq!((node.progress().state, node.has_staged(&NEW)), (State::Installed, true), "{size:#x}");
    }
}

/// After a power cut the record reads differently each time: confirmed in the resident part, staged in the image.
#[test]
fn an_image_that_was_loaded_as_confirmed_is_installed() {
    let mut board = Board::new(&OLD);
    board.start().stage(&NEW);
    board.off();
    let mut node = board.wake_as(Origin::Confirmed, TrialEnd::None);
    node.settle();
    assert_eq!((node.progress().state, node.word(0x1F57)), (State::Installed, 0));
    assert_eq!(board.flash.cells(HOME)[..NEW.len()], **NEW);
}

#[test]
fn a_damaged_home_is_repaired_from_the_spare() {
    let mut board = Board::new(&OLD);
    board.renew(&NEW);
    board.off();
    for at in [0, 4, 0x20, 0x2FF] {
        let mut cells = board.flash.cells(HOME).to_vec();
        cells[at] &= !(cells[at] & cells[at].wrapping_neg());
        board.flash.poke(HOME.base, &cells);
        assert_eq!(board.loads().1, Origin::Spare);
        let mut node = board.start();
        let Progress { state, origin, .. } = node.progress();
        assert_eq!((state, origin), (State::Installed, Origin::Spare));
        assert_eq!(board.flash.cells(HOME)[..NEW.len()], **NEW, "byte {at}");
        board.off();
        assert_eq!(board.loads().1, Origin::Home);
    }
}

/// The seeded master has found it: the repair fails, and the only good image lies in staging.
#[test]
fn a_spare_is_kept_until_home_is_repaired() {
    // The first store of the repair, and a word of home.
    for after in [1, 12] {
        let mut board = Board::new(&OLD);
        board.renew(&NEW);
        board.off();
        let mut cells = board.flash.cells(HOME).to_vec();
        cells[0x80] = 0;
        board.flash.poke(HOME.base, &cells);
        board.flash.fail = Some((board.flash.operations + after, FlashFault::Failed));
        let mut node = board.start();
        assert_ne!(node.word(0x1F57), 0, "{after}: the repair has failed");
        assert_eq!(node.progress().origin, Origin::Spare);
        for program in [1, N] {
            let image = if program == N {
                block_file_at(&OLD, HOME.base, 200)
            } else {
                block_file_at(&program_of(0x3400), PROGRAM.base, 200)
            };
            let _ = node.try_command(program, CLEAR);
            assert_eq!(node.send(program, &image[0]), Err(AbortCode::DEVICE_STATE), "{after}: {program}");
            assert_eq!(node.status(program), BUSY, "{after}: {program}");
        }
        assert_eq!(node.command(N, CONFIRM), 0, "83h tries again");
        assert_eq!(board.flash.cells(HOME)[..NEW.len()], **NEW);
        board.off();
        let mut node = board.start();
        assert_eq!((node.progress().state, node.progress().origin), (State::Installed, Origin::Home));
        assert_eq!(node.command(N, CLEAR), 0);
        assert_eq!(
            node.send(N, &block_file_at(&OLD, HOME.base, 200)[0]),
            Ok(()),
            "the spare is none any more"
        );
    }
}

/// Clears the lowest bit of a cell that has one.
fn decay(flash: &mut ModelFlash, at: u32) {
    let cell = flash.cells(Region::new(at, 1))[0];
    assert_ne!(cell, 0);
    flash.poke(at, &[cell & (cell - 1)]);
}

/// Home is the only other good bootloader: it is erased for an image that is whole, and for no other.
#[test]
fn an_image_that_has_decayed_since_its_start_does_not_cost_home() {
    for at in [0, 4, 0x20, 0x41, 0x2FF] {
        let mut board = Board::on_trial(&OLD, &NEW);
        let mut node = board.start();
        decay(node.0.flash(), STAGING.base + at);
        assert_eq!(node.command(N, CONFIRM), NO_VALID_PROGRAM, "byte {at}");
        assert_eq!(node.progress().state, State::None, "byte {at}");
        assert_eq!(board.flash.cells(HOME)[..OLD.len()], **OLD, "byte {at}");
        board.off();
        board.renew(&NEW);
        board.off();
        board.check([&NEW, &NEW]);
    }
    // Nor does a whole one that nobody has tried, from a probe.
    let mut board = Board::on_trial(&OLD, &NEW);
    let mut node = board.start();
    node.0.flash().poke(STAGING.base, &image(0x300, 3));
    assert_eq!(node.command(N, CONFIRM), NO_VALID_PROGRAM);
    assert_eq!(board.flash.cells(HOME)[..OLD.len()], **OLD);
}

/// 1F57h/n is busy until the image is installed: that is what a tool waits for. A program that is being
/// downloaded meanwhile makes no difference.
#[test]
fn an_installation_is_busy_to_its_end() {
    for downloads in [false, true] {
        let mut board = Board::on_trial(&OLD, &NEW);
        let mut node = board.start();
        if downloads {
            assert_eq!(node.command(1, CLEAR), 0);
            node.send_all(1, &block_file_at(&program_of(0x1000), PROGRAM.base, 200)[..3]);
        }
        node.try_command(N, CONFIRM).unwrap();
        while node.progress().state != State::Installed {
            assert_eq!(node.word(0x1F57) & 1, 1, "{downloads}: {:?}", node.progress());
            assert_ne!(node.0.step(), Step::Idle);
        }
        node.settle();
        assert_eq!(node.word(0x1F57), 0);
    }
}

/// Somebody protects home while it is erased or written: 1F57h names its sector.
#[test]
fn a_home_that_is_protected_in_the_middle_is_named() {
    // Before it is erased, and when half of it is written.
    for until in [&[][..], &NEW[..0x100]] {
        let mut board = Board::on_trial(&OLD, &NEW);
        let mut node = board.start();
        node.try_command(N, CONFIRM).unwrap();
        // The record that permits the erase is stored.
        while node.progress().state != State::Confirmed || !node.0.flash().cells(HOME).starts_with(until) {
            assert_ne!(node.0.step(), Step::Idle);
        }
        node.0.flash().protected = vec![4];
        node.settle();
        assert_eq!((node.word(0x1F57), node.progress().state), (SECURED | 4 << 16, State::Confirmed));
        node.0.flash().protected.clear();
        assert_eq!((node.command(N, CONFIRM), node.progress().state), (0, State::Installed));
    }
}

/// And it is installed when the whole copy is what was staged: both decay while home is being written.
#[test]
fn a_copy_is_compared_before_it_counts_as_installed() {
    for place in [STAGING, HOME] {
        let mut board = Board::on_trial(&OLD, &NEW);
        let mut node = board.start();
        node.try_command(N, CONFIRM).unwrap();
        // The first words are there, the last ones are not.
        while node.0.flash().cells(HOME)[..0x100] != NEW[..0x100] {
            assert_ne!(node.0.step(), Step::Idle);
        }
        let at = if place == HOME { 0x80 } else { 0x2FF };
        decay(node.0.flash(), place.base + at);
        node.settle();
        assert_eq!(node.word(0x1F57), WRITE, "{place:?}");
        assert_eq!(node.progress().state, State::Confirmed, "{place:?}");
        // 83h tries again: from what is still good, and from nothing else.
        let status = node.command(N, CONFIRM);
        let state = node.progress().state;
        match place {
            HOME => assert_eq!((status, state), (0, State::Installed)),
            _ => assert_eq!((status, state), (NO_VALID_PROGRAM, State::None)),
        }
    }
}

/// A debug probe writes another bootloader while a record of the old one is stored.
#[test]
fn an_image_from_a_probe_makes_the_record_void() {
    let (old, new, probed) = (image(0x200, 1), image(0x300, 2), image(0x240, 3));
    for confirmed in [false, true] {
        let mut board = Board::new(&old);
        board.start().stage(&new);
        if confirmed {
            // The power is cut when home is half erased.
            board.leave(Some(BootRequest::Renewal(TrialStep::Try)));
            board.flash.cut = Some((board.flash.operations + 12, Cut::Torn(1)));
            assert!(until_power_cut(|| {
                board.start().command(N, CONFIRM);
            }));
        }
        board.off();
        board.flash.poke(HOME.base, &[0xFF; HOME.size as usize]);
        board.flash.poke(HOME.base, &probed);
        assert_eq!(board.loads().0.crc, crc_of(&probed));
        let mut node = board.start();
        assert_eq!(node.progress().state, State::None, "confirmed: {confirmed}");
        assert_eq!(board.flash.cells(HOME)[..probed.len()], probed);
    }
}

/// The bootloader from before an installation, written by a probe, is foreign as well.
#[test]
fn an_older_image_from_a_probe_makes_the_record_of_an_installed_one_void() {
    let mut board = Board::new(&OLD);
    board.renew(&NEW);
    board.off();
    board.flash.poke(HOME.base, &[0xFF; HOME.size as usize]);
    board.flash.poke(HOME.base, &OLD);
    let mut node = board.start();
    assert_eq!(node.progress(), Progress::default());
    // So its damage is none that the newer one repairs behind the owner's back.
    board.off();
    let journal = Journal::open(&board.flash, LAYOUT.parameters);
    assert_eq!(RenewalRecord::load(&journal, &board.flash), None);
}

/// While an image is confirmed and not installed, nothing else touches its flash.
#[test]
fn a_confirmed_image_is_kept_until_it_is_installed() {
    let mut board = Board::on_trial(&OLD, &NEW);
    let mut node = board.start();
    // The installation fails: home cannot be erased.
    node.0.flash().protected = vec![4];
    assert_eq!(node.command(N, CONFIRM), SECURED | 4 << 16);
    assert_eq!(node.progress().state, State::Staged, "nothing is lost, and nothing was promised");
    // It fails in the middle: the first word of home.
    node.0.flash().protected = vec![];
    let erased = node.0.flash().operations + 9;
    node.0.flash().fail = Some((erased, FlashFault::Failed));
    assert_eq!(node.command(N, CONFIRM), 0x0A);
    assert_eq!(node.progress().state, State::Confirmed);
    assert_eq!(node.try_command(1, CLEAR), Err(AbortCode::DEVICE_STATE));
    assert_eq!(node.status(1), BUSY);
    let first = &block_file_at(&NEW, HOME.base, 200)[0];
    for program in [1, N] {
        assert_eq!(node.send(program, first), Err(AbortCode::DEVICE_STATE), "{program}");
        assert_eq!(node.status(program), BUSY);
    }
    // A second 83h tries again.
    assert_eq!(node.command(N, CONFIRM), 0);
    assert_eq!(node.progress().state, State::Installed);
}

/// While a block is written, a CLEAR begins the own download again, and other commands are refused.
#[test]
fn a_clear_alone_breaks_off_the_own_download() {
    let mut board = Board::new(&OLD);
    let mut node = board.start();
    assert_eq!(node.command(N, CLEAR), 0);
    let mut blocks = block_file_at(&NEW, HOME.base, 200).into_iter();
    node.send(N, &blocks.next().unwrap()).unwrap();
    node.push(N, &blocks.next().unwrap()).unwrap();
    for command in [CONFIRM, WITHDRAW, START] {
        assert_eq!(node.try_command(N, command), Err(AbortCode::DEVICE_STATE), "{command:X}h");
    }
    assert_eq!(node.try_command(N, CLEAR), Ok(()));
    node.settle();
    node.stage(&NEW);
}

/// A master that does not know this number, and writes to every sub-index.
#[test]
fn commands_by_themselves_change_nothing() {
    let old = image(0x200, 1);
    let mut board = Board::new(&old);
    let before = board.flash.clone();
    let mut node = board.start();
    for command in [0, 0x80, CLEAR, CLEAR, CLEAR, 2, CONFIRM, WITHDRAW] {
        assert_eq!(node.command(N, command), 0, "{command}");
    }
    assert_eq!(node.command(N, START), NO_VALID_PROGRAM);
    assert_eq!(node.0.take_boot_request(), None);
    assert_eq!(node.try_command(N, 0x55), Err(AbortCode::INVALID_VALUE));
    assert_eq!(board.flash.cells(CHIP.flash), before.cells(CHIP.flash));
}

/// A device with a password takes a new bootloader after it, as it takes a program.
#[test]
fn a_password_opens_the_bootloader_too() {
    for setup in RENEWALS.iter().filter(|setup| setup.password(1).is_some() && !setup.takes_sealed) {
        let number = setup.profile.extras.bootloader.unwrap();
        let mut flash = ModelFlash::new(&CHIP);
        flash.poke(HOME.base, &image(0x200, 1));
        let mut rig = Rig::on(setup, 512, flash);
        let blocks = block_file_at(&image(0x300, 2), HOME.base, 200);
        assert_eq!(rig.send(number, &blocks[0]), Err(AbortCode::DEVICE_STATE), "{}", setup.name);
        assert_eq!(rig.status(number), 0x84, "{}", setup.name);
        rig.unlock(number).unwrap();
        for block in blocks {
            assert_eq!(rig.send(number, &block), Ok(()), "{}", setup.name);
            rig.settle();
        }
        let [state, ..] = rig.word(0x2007, 9).to_le_bytes();
        assert_eq!((rig.status(number), state), (0, State::Staged as u8), "{}", setup.name);
    }
}
