//! One download to several servers.

mod common;
#[path = "../../tests/src/random.rs"]
#[allow(dead_code, reason = "the tests need some of it")]
mod random;

use canopen::frame::Channel;
use canopen::sdo::client::{Config as ClientConfig, GroupDownload, GroupStep, Servers};
use canopen::sdo::server::Config;
use canopen::{AbortCode, Address, CobId, Frame};
use common::{at, Bench, Event};
use random::Random;

const AT: Address = Address::new(0x1F50, 1);
const TIMEOUT: ClientConfig = ClientConfig { timeout_ms: 500 };

fn id(number: u16) -> CobId {
    CobId::new(number).unwrap()
}

/// Devices with common requests (6DFh), and answers of their own (681h and so on).
struct Group {
    benches: Vec<Bench>,
    now: u32,
    /// The frames on the bus.
    frames: u32,
}

impl Group {
    fn new(count: u16) -> Self {
        let bench = |number| {
            let mut bench = Bench::with(Config::DEFAULT);
            bench.device.second = Some(Channel { request: id(0x6DF), response: id(0x681 + number) });
            bench
        };
        Self { benches: (0..count).map(bench).collect(), now: 0, frames: 0 }
    }

    fn all(&self) -> Servers {
        (1 << self.benches.len()) - 1
    }

    /// One attempt; `hears` tells which device hears which frame, and which answer is heard.
    fn download(
        &mut self,
        data: &[u8],
        mut hears: impl FnMut(usize, &Frame) -> bool,
    ) -> (Servers, Vec<(usize, AbortCode)>) {
        let mut download = GroupDownload::new(id(0x6DF), self.all(), AT, data, TIMEOUT);
        let mut refused = Vec::new();
        loop {
            let step = download.poll(at(self.now));
            let wait = match step {
                GroupStep::Done(missing) => return (missing, refused),
                GroupStep::Send(frame) => {
                    self.frames += 1;
                    for (number, bench) in self.benches.iter_mut().enumerate() {
                        bench.now = self.now;
                        if hears(number, &frame) {
                            bench.send(&frame);
                        }
                    }
                    false
                }
                GroupStep::Wait(_) => true,
            };
            self.now += u32::from(wait);
            for number in 0..self.benches.len() {
                self.benches[number].now = self.now;
                for answer in self.benches[number].sent() {
                    self.frames += 1;
                    assert!(answer.has_cob_id(id(0x681 + number as u16)));
                    if hears(number, &answer) {
                        if let Err(code) = download.handle(number, answer.exactly().unwrap(), at(self.now)) {
                            refused.push((number, code));
                        }
                    }
                }
            }
        }
    }
}

fn data(len: usize) -> Vec<u8> {
    (0..len).map(|i| (i * 7 + i / 256) as u8).collect()
}

#[test]
fn all_devices_take_data_of_any_length_and_each_frame_is_sent_once() {
    for len in [1, 4, 7, 8, 14, 889, 890, 1040, 16384] {
        let data = data(len);
        let mut group = Group::new(5);
        assert_eq!(group.download(&data, |_, _| true), (0, Vec::new()), "{len}");
        let segments = len.div_ceil(7) as u32;
        // Initiate, segments and end once; from each device the answers to initiate and end, and
        // one for each 127 segments.
        let answers = 2 + segments.div_ceil(127);
        assert_eq!(group.frames, 2 + segments + 5 * answers, "{len}");
        for bench in &group.benches {
            assert_eq!(
                bench.device.events,
                [Event::Start(Some(len as u32)), Event::End(data.clone())],
                "{len}"
            );
        }
    }
}

/// A lost frame of any kind breaks the download off for all, and the next attempt gets through.
#[test]
fn a_frame_that_one_device_loses_ends_the_attempt() {
    let data = data(2000);
    let frames = {
        let mut group = Group::new(3);
        group.download(&data, |_, _| true);
        group.frames
    };
    for lost in 0..frames {
        let mut group = Group::new(3);
        let mut count = 0;
        let (missing, refused) = group.download(&data, |number, _| {
            count += u32::from(number == 1);
            number != 1 || count != lost + 1
        });
        if count <= lost {
            break;
        }
        assert!(refused.iter().all(|(number, _)| *number == 1), "{lost}: {refused:?}");
        assert!(missing == 0b010, "{lost}: {missing:b}");
        assert_eq!(group.download(&data, |_, _| true), (0, Vec::new()), "{lost}");
        for bench in &group.benches {
            assert_eq!(bench.device.events.last(), Some(&Event::End(data.clone())), "{lost}");
        }
    }
}

/// One of a thousand frames is lost at one of eight devices, in either direction: attempts until
/// all have the data.
#[test]
fn with_lost_frames_every_device_gets_the_data() {
    let data = data(1040);
    let mut random = Random(7);
    let mut attempts = 0;
    for _ in 0..200 {
        let mut group = Group::new(8);
        let mut has = 0;
        for attempt in 1.. {
            assert!(attempt < 100);
            attempts += 1;
            let (missing, _) = group.download(&data, |_, _| random.below(1000) != 0);
            has |= group.all() & !missing;
            if missing == 0 {
                break;
            }
        }
        assert_eq!(has, group.all());
        for bench in &group.benches {
            assert_eq!(bench.device.events.last(), Some(&Event::End(data.clone())));
        }
    }
    // 1.6 of 200 would be too good: 8 devices hear 155 frames each.
    assert!(attempts > 300, "{attempts}");
}

#[test]
fn a_device_that_refuses_is_named_with_its_reason() {
    let mut group = Group::new(3);
    group.benches[2].device.refuse_end = Some(AbortCode::DEVICE_STATE);
    let (missing, refused) = group.download(&data(100), |_, _| true);
    assert_eq!((missing, refused), (0b100, vec![(2, AbortCode::DEVICE_STATE)]));
    // The others have taken the data.
    for bench in &group.benches[..2] {
        assert_eq!(bench.device.events.last(), Some(&Event::End(data(100))));
    }
}

/// Answers that no server of the standard gives.
#[test]
fn hostile_answers_neither_hang_nor_panic() {
    let mut random = Random(11);
    for _ in 0..2000 {
        let data = data(random.below(900) + 1);
        let mut download = GroupDownload::new(id(0x6DF), 0b111, AT, &data, TIMEOUT);
        let mut now = 0;
        for step in 0.. {
            assert!(step < 5000, "it does not end");
            match download.poll(at(now)) {
                GroupStep::Done(_) => break,
                GroupStep::Send(_) => {}
                GroupStep::Wait(_) => now += 50,
            }
            let mut bytes = [0; 8];
            bytes.iter_mut().for_each(|byte| *byte = random.below(256) as u8);
            if random.below(2) == 0 {
                // What would fit.
                bytes[..4].copy_from_slice(&[0xA4, 0x50, 0x1F, 1]);
            }
            let _ = download.handle(random.below(200), &bytes, at(now));
        }
    }
}
