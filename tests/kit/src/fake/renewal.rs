//! A device whose bootloader can be renewed, played from docs/protocol.md: 2007h/1, /8 and /9, and the
//! sub-index 2 of 1F50h to 1F57h.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::{Bus, Deed, Fake, Maker, BOOTLOADER, NODE};

/// Abort codes (CiA 301 table 22).
pub const NO_OBJECT: u32 = 0x0602_0000;
pub const NOT_STORED: u32 = 0x0800_0020;
pub const NOT_NOW: u32 = 0x0800_0022;

/// The states in 2007h/9.
pub const NONE: u8 = 0;
pub const STAGED: u8 = 1;
pub const CONFIRMED: u8 = 2;
pub const INSTALLED: u8 = 3;
/// The origins in 2007h/9.
pub const HOME: u8 = 0;
pub const TRIAL: u8 = 1;

pub const OLD: u32 = 0x0001_0002;
pub const NEW: u32 = 0x0001_0003;
pub const OLD_CRC: u32 = 0x1234_5678;

/// A RAM image, typed from the table of its header; its CRC is that of the words after the CRC.
pub fn image(version: u32) -> Vec<u8> {
    let mut bytes = b"CBI2".to_vec();
    for word in [0, 64, 256, 0x2000_0000, 0x2001_FFC0, 1, 0, 7, 1, 2, 0, version, 0, 0, 0] {
        bytes.extend(u32::to_le_bytes(word));
    }
    bytes.extend(0..=255_u8);
    let crc = crate::crc::crc32(&bytes[8..]);
    bytes[4..8].copy_from_slice(&crc.to_le_bytes());
    bytes
}

pub fn word_of(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

/// What becomes of the image on trial.
#[derive(Clone, Copy)]
pub enum Trial {
    /// It answers.
    Works,
    /// It answers, and knows nothing of a renewal.
    Without,
    /// The old one is back, with these bytes in 2007h/9.
    Ends([u8; 2]),
    /// Nobody hears it, and the old one is back after this time, with these bytes in 2007h/9.
    Deaf(Duration, [u8; 2]),
}

/// A device whose bootloader can be renewed.
pub struct Board {
    pub node: u8,
    /// 2007h/1; `None` if it has no such object.
    pub number: Option<u8>,
    pub state: u8,
    pub origin: u8,
    pub end: [u8; 2],
    pub home: (u32, u32),
    pub staging: Option<(u32, u32)>,
    pub trial: Trial,
    /// How many reads of 1F57h are busy.
    pub busy: u32,
    pub status: u32,
    /// How a download is refused: the abort code, and then 1F57h.
    pub refuses: Option<(u32, u32)>,
    /// How the installation fails: 1F57h.
    pub fails: Option<u32>,
    /// Whether the image on trial wants a password.
    pub locked: bool,
    pub log: Log,
}

/// The writes to the bootloader's own sub-index.
pub type Log = Arc<Mutex<Vec<String>>>;

impl Board {
    pub fn new(log: &Log) -> Self {
        Self {
            node: NODE,
            number: Some(2),
            state: NONE,
            origin: HOME,
            end: [0; 2],
            home: (OLD, OLD_CRC),
            staging: None,
            trial: Trial::Works,
            busy: 0,
            status: 0,
            refuses: None,
            fails: None,
            locked: false,
            log: log.clone(),
        }
    }

    /// Version and CRC of what runs.
    fn runs(&self) -> (u32, u32) {
        self.staging.filter(|_| self.origin != HOME).unwrap_or(self.home)
    }

    fn restart(&mut self, origin: u8, end: [u8; 2]) -> Deed {
        (self.origin, self.end) = (origin, end);
        Deed::Restart(self.node, BOOTLOADER)
    }

    fn command(&mut self, command: u8) -> Result<Deed, u32> {
        self.log.lock().unwrap().push(format!("{command:02X}"));
        if self.busy > 0 {
            self.status = 0x86;
            return Err(NOT_NOW);
        }
        self.status = 0;
        let on_trial = self.origin == TRIAL && self.state == STAGED;
        if self.locked && on_trial {
            self.status = 0x84;
            return Err(NOT_NOW);
        }
        Ok(match command {
            0x03 | 0x84 if on_trial => self.restart(HOME, [2, 0]),
            0x01 if self.state == STAGED && self.origin != TRIAL => match self.trial {
                Trial::Works | Trial::Without => self.restart(TRIAL, [0; 2]),
                Trial::Ends(end) => self.restart(HOME, end),
                Trial::Deaf(time, end) => {
                    self.end = end;
                    Deed::RestartIn(time, self.node, BOOTLOADER)
                }
            },
            0x83 if on_trial || self.state == CONFIRMED => {
                self.busy = 3;
                match self.fails.take() {
                    Some(status) => (self.state, self.status) = (CONFIRMED, status),
                    None => (self.state, self.home) = (INSTALLED, self.staging.unwrap()),
                }
                Deed::Nothing
            }
            0x01 => {
                self.status = 0x02;
                Deed::Nothing
            }
            _ => Deed::Nothing,
        })
    }

    fn download(&mut self, data: &[u8]) -> Result<Deed, u32> {
        self.log.lock().unwrap().push(format!("{} bytes", data.len()));
        if let Some((code, status)) = self.refuses {
            self.status = status;
            return Err(code);
        }
        assert_eq!(data, image(NEW), "the image alone, as it lies in flash");
        (self.state, self.staging) = (STAGED, Some((word_of(data, 48), word_of(data, 4))));
        Ok(Deed::Nothing)
    }
}

impl Maker for Board {
    fn value(&mut self, at: (u16, u8), running: u32) -> Option<Result<Vec<u8>, u32>> {
        if running != BOOTLOADER {
            return None;
        }
        let number = match at {
            (0x2007, 1) => return Some(self.number.map(|number| vec![number]).ok_or(NO_OBJECT)),
            _ => self.number?,
        };
        match at {
            (0x1F50 | 0x1F51 | 0x1F56 | 0x1F57, 0) => Some(Ok(vec![number])),
            (0x2007, 8) => Some(Ok((u64::from(self.runs().0) | 1 << 32).to_le_bytes().to_vec())),
            (0x2007, 9) if self.origin == TRIAL && matches!(self.trial, Trial::Without) => {
                Some(Err(NO_OBJECT))
            }
            (0x2007, 9) => Some(Ok([&[self.state, self.origin][..], &self.end].concat())),
            (0x1F51, 2) => Some(Ok(vec![1])),
            (0x1F56, 2) => Some(Ok(self.runs().1.to_le_bytes().to_vec())),
            (0x1F57, 2) if self.busy > 0 => {
                self.busy -= 1;
                Some(Ok(vec![1, 0, 0, 0]))
            }
            (0x1F57, 2) => Some(Ok(self.status.to_le_bytes().to_vec())),
            _ => None,
        }
    }

    fn write(&mut self, at: (u16, u8), data: &[u8], running: u32) -> Option<Result<Deed, u32>> {
        match at {
            (0x1F51, 2) if running == BOOTLOADER => Some(self.command(data[0])),
            (0x1F50, 2) if running == BOOTLOADER => Some(self.download(data)),
            _ => None,
        }
    }

    fn reset(&mut self, _: u32) -> Option<(u8, u32)> {
        self.origin = HOME;
        Some((self.node, BOOTLOADER))
    }
}

/// A device with this board; `change` changes it first.
pub fn device(running: u32, change: impl FnOnce(&mut Board)) -> (Fake, Log) {
    let log = Log::default();
    let mut board = Board::new(&log);
    change(&mut board);
    let mut fake = Fake::new(running);
    fake.maker = Some(Box::new(board));
    (fake, log)
}

/// Devices with these node-IDs and trials.
pub fn devices(trials: [Trial; 3]) -> (Bus, Log) {
    let log = Log::default();
    let device = |(node, trial): (u8, Trial)| {
        let board = Board { node, trial, ..Board::new(&log) };
        let mut fake = Fake::new(BOOTLOADER);
        fake.node = node;
        fake.maker = Some(Box::new(board));
        fake
    };
    (Bus([5, 6, 7].into_iter().zip(trials).map(device).collect()), log)
}
