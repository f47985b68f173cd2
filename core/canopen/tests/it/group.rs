//! One download to several servers.

use canopen::frame::Channel;
use canopen::sdo::client::{Config as ClientConfig, GroupDownload, GroupResult, GroupStep, Servers};
use canopen::sdo::server::Config;
use canopen::{AbortCode, Address, CobId, Frame};
use kit::bus::{at, Bench, Event};
use kit::random::Random;

const AT: Address = Address::new(0x1F50, 1);
const WHOLE: GroupResult = GroupResult { missing: 0, ended: true };
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

    /// Who has taken exactly these data. Nobody has taken others.
    fn who_has(&self, data: &[u8]) -> Servers {
        let mut has = 0;
        for (number, bench) in self.benches.iter().enumerate() {
            for event in &bench.device.events {
                if let Event::End(taken) = event {
                    assert_eq!(taken, data, "device {number}");
                    has |= 1 << number;
                }
            }
        }
        has
    }

    /// One attempt; `hears` says whether a request gets to the bus (`None`), which device hears
    /// it, and which answer is heard.
    fn download(
        &mut self,
        data: &[u8],
        mut hears: impl FnMut(Option<usize>, &Frame) -> bool,
    ) -> (GroupResult, Vec<(usize, AbortCode)>) {
        let mut download = GroupDownload::new(id(0x6DF), self.all(), AT, data, TIMEOUT);
        let mut refused = Vec::new();
        loop {
            let step = download.poll(at(self.now));
            let wait = match step {
                GroupStep::Done(result) => return (result, refused),
                GroupStep::Send(frame) => {
                    self.frames += 1;
                    let arrives = hears(None, &frame);
                    for (number, bench) in self.benches.iter_mut().enumerate() {
                        bench.now = self.now;
                        if arrives && hears(Some(number), &frame) {
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
                    if hears(Some(number), &answer) {
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
        assert_eq!(group.download(&data, |_, _| true), (WHOLE, Vec::new()), "{len}");
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

/// Whichever frame one device loses, it alone can be without the data, and nobody has wrong ones.
#[test]
fn a_frame_that_one_device_loses_costs_nobody_else_the_data() {
    let data = data(2000);
    for lost in 0.. {
        let mut group = Group::new(3);
        let mut count = 0;
        let (result, refused) = group.download(&data, |number, _| {
            count += u32::from(number == Some(1));
            number != Some(1) || count != lost + 1
        });
        if count <= lost {
            // More frames than segments: answers were lost, too.
            assert!(lost > 286 + 4, "{lost}");
            break;
        }
        assert!(refused.iter().all(|(number, _)| *number == 1), "{lost}: {refused:?}");
        assert_eq!(result.missing & !0b010, 0, "{lost}: {result:?}");
        if result.ended {
            assert_eq!(group.who_has(&data) | result.missing, 0b111, "{lost}");
        }
        assert_eq!(group.download(&data, |_, _| true), (WHOLE, Vec::new()), "{lost}");
        assert_eq!(group.who_has(&data), 0b111, "{lost}");
    }
}

/// A request that no device hears is repeated within the transfer, unless it is the first or the
/// last frame.
#[test]
fn a_segment_that_all_lose_is_sent_again() {
    let data = data(2000);
    let segments = 286;
    for lost in 0..segments + 2 {
        let mut group = Group::new(3);
        let mut count = 0;
        let (result, refused) = group.download(&data, |number, _| {
            count += u32::from(number.is_none());
            number.is_some() || count != lost + 1
        });
        assert_eq!(refused, []);
        if lost == 0 || lost == segments + 1 {
            assert_eq!(result, GroupResult { missing: 0b111, ended: lost != 0 }, "{lost}");
        } else {
            assert_eq!(result, WHOLE, "{lost}");
            assert_eq!(group.who_has(&data), 0b111, "{lost}");
            // The rest of one sub-block, and of each device an acknowledgement.
            assert!(group.frames <= 2 + segments + 3 * 5 + 127 + 3, "{lost}: {}", group.frames);
        }
    }
}

/// One of a thousand frames is lost: for the whole bus, or at one of eight devices, in either
/// direction. Attempts until all have the data.
#[test]
fn with_lost_frames_every_device_gets_the_data() {
    let data = data(1040);
    let mut random = Random(7);
    let mut attempts_of = |bus: bool| {
        let mut attempts = 0;
        for _ in 0..200 {
            let mut group = Group::new(8);
            for attempt in 1.. {
                assert!(attempt < 100);
                attempts += 1;
                let loses = |number: Option<usize>, frame: &Frame| {
                    let answer = !frame.has_cob_id(id(0x6DF));
                    (bus && !answer && number.is_some()) || random.below(1000) != 0
                };
                group.download(&data, loses);
                if group.who_has(&data) == group.all() {
                    break;
                }
            }
        }
        attempts
    };
    // Without repetition in the transfer are the first and the last request and their answers, 18
    // frames; of all 1240 frames that devices hear and send, each costs its device the data.
    let (bus, devices) = (attempts_of(true), attempts_of(false));
    assert!((201..240).contains(&bus), "{bus}");
    assert!((300..480).contains(&devices), "{devices}");
}

#[test]
fn a_device_that_refuses_is_named_with_its_reason() {
    let mut group = Group::new(3);
    group.benches[2].device.refuse_end = Some(AbortCode::DEVICE_STATE);
    let (result, refused) = group.download(&data(100), |_, _| true);
    assert_eq!(result, GroupResult { missing: 0b100, ended: true });
    assert_eq!(refused, [(2, AbortCode::DEVICE_STATE)]);
    // The others have taken the data.
    for bench in &group.benches[..2] {
        assert_eq!(bench.device.events.last(), Some(&Event::End(data(100))));
    }
}

/// A late abort for the object of an earlier transfer breaks nothing off.
#[test]
fn an_abort_for_another_object_concerns_no_device() {
    let data = data(2000);
    let mut group = Group::new(3);
    let mut download = GroupDownload::new(id(0x6DF), group.all(), AT, &data, TIMEOUT);
    let result = loop {
        for (index, sub) in [(0x1F57_u16, 1), (0x1F50, 2)] {
            let [low, high] = index.to_le_bytes();
            let late = [0x80, low, high, sub, 0, 0, 4, 5];
            assert_eq!(download.handle(1, &late, at(group.now)), Ok(()));
        }
        match download.poll(at(group.now)) {
            GroupStep::Done(result) => break result,
            GroupStep::Send(frame) => group.benches.iter_mut().for_each(|bench| bench.send(&frame)),
            GroupStep::Wait(_) => group.now += 1,
        }
        for (number, bench) in group.benches.iter_mut().enumerate() {
            bench.now = group.now;
            for answer in bench.sent() {
                download.handle(number, answer.exactly().unwrap(), at(group.now)).unwrap();
            }
        }
    };
    assert_eq!((result, group.who_has(&data)), (WHOLE, 0b111));
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

/// The frames of one download of 20 bytes to two servers, written by hand from CiA 301 section
/// 7.2.4.3.9: three segments, of which the last has one byte that is no data.
mod by_hand {
    use super::*;

    const TAKEN: [u8; 8] = [0xA1, 0, 0, 0, 0, 0, 0, 0];
    /// 08000020h.
    const REFUSED: [u8; 8] = [0x80, 0x50, 0x1F, 1, 0x20, 0x00, 0x00, 0x08];
    /// 08000000h and 05040000h, to all servers.
    const GENERAL: [u8; 8] = [0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x00, 0x08];
    const TIMED_OUT: [u8; 8] = [0x80, 0x50, 0x1F, 1, 0x00, 0x00, 0x04, 0x05];
    /// How long all servers may be silent, and one when the others have answered.
    const SILENT_MS: u32 = 500;
    const LATE_MS: u32 = 120;

    fn granted(blksize: u8) -> [u8; 8] {
        [0xA4, 0x50, 0x1F, 1, blksize, 0, 0, 0]
    }

    fn acknowledged(ackseq: u8, blksize: u8) -> [u8; 8] {
        [0xA2, ackseq, blksize, 0, 0, 0, 0, 0]
    }

    /// A download to the servers 0 and 1, whose initiate is sent at 0 ms.
    struct Master(GroupDownload<[u8; 20]>);

    impl Master {
        fn begun() -> Self {
            Self::begun_to(0b11)
        }

        fn begun_to(servers: Servers) -> Self {
            let mut master = Self(GroupDownload::new(id(0x6DF), servers, AT, [0x55; 20], TIMEOUT));
            master.sends(0, [0xC6, 0x50, 0x1F, 1, 20, 0, 0, 0]);
            master
        }

        /// With this block size granted by both.
        fn with_blocks_of(blksize: u8) -> Self {
            let mut master = Self::begun();
            master.hears(0, granted(blksize), 0);
            master.hears(1, granted(blksize), 0);
            master
        }

        /// With the three segments sent at 0 ms.
        fn sent() -> Self {
            let mut master = Self::with_blocks_of(127);
            master.sends(0, [1, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55]);
            master.sends(0, [2, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55]);
            master.sends(0, [0x83, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55, 0x00]);
            master
        }

        /// With the end sent at 0 ms.
        fn ended() -> Self {
            let mut master = Self::sent();
            master.hears(0, acknowledged(3, 127), 0);
            master.hears(1, acknowledged(3, 127), 0);
            master.ends_data(0);
            master
        }

        #[track_caller]
        fn sends(&mut self, now: u32, bytes: [u8; 8]) {
            assert_eq!(self.0.poll(at(now)), GroupStep::Send(Frame::of(id(0x6DF), &bytes)));
        }

        /// The end of the data: one byte is not used.
        #[track_caller]
        fn ends_data(&mut self, now: u32) {
            match self.0.poll(at(now)) {
                GroupStep::Send(frame) => assert_eq!(frame.exactly::<8>().unwrap()[0], 0xC5),
                other => panic!("{other:?}"),
            }
        }

        #[track_caller]
        fn hears(&mut self, server: usize, bytes: [u8; 8], now: u32) {
            assert_eq!(self.0.handle(server, &bytes, at(now)), Ok(()));
        }

        #[track_caller]
        fn is_refused_by(&mut self, server: usize) {
            assert_eq!(self.0.handle(server, &REFUSED, at(0)), Err(AbortCode(0x0800_0020)));
        }

        #[track_caller]
        fn waits(&mut self, now: u32, until: u32) {
            assert_eq!(self.0.poll(at(now)), GroupStep::Wait(at(until)));
        }

        /// Its end, which nothing changes any more.
        #[track_caller]
        fn is_done(&mut self, missing: Servers, ended: bool) {
            let done = GroupStep::Done(GroupResult { missing, ended });
            assert_eq!(self.0.poll(at(0)), done);
            self.0.abort();
            self.hears(0, TAKEN, 0);
            self.hears(1, REFUSED, 0);
            assert_eq!(self.0.poll(at(9999)), done);
        }
    }

    #[test]
    fn a_download_to_two() {
        let mut master = Master::ended();
        master.hears(1, TAKEN, 0);
        master.waits(0, LATE_MS);
        master.hears(0, TAKEN, 0);
        master.is_done(0, true);
    }

    #[test]
    fn who_refuses_before_the_end_ends_the_download_for_all() {
        let mut one_granted = Master::begun();
        one_granted.hears(0, granted(127), 0);
        let mut half_sent = Master::with_blocks_of(127);
        half_sent.sends(0, [1, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55]);
        let mut all_acknowledged = Master::sent();
        all_acknowledged.hears(0, acknowledged(3, 127), 0);
        all_acknowledged.hears(1, acknowledged(3, 127), 0);
        for mut master in [Master::begun(), one_granted, half_sent, Master::sent(), all_acknowledged] {
            master.is_refused_by(1);
            master.sends(0, GENERAL);
            master.is_done(0b10, false);
        }
    }

    /// The end of a download is each server's own.
    #[test]
    fn who_refuses_the_end_is_alone_without_the_data() {
        let mut master = Master::ended();
        master.hears(0, TAKEN, 0);
        master.hears(0, REFUSED, 0);
        master.waits(0, LATE_MS);
        master.is_refused_by(1);
        // An abort ends the transfer of a server that has not understood the end.
        master.sends(0, GENERAL);
        master.is_done(0b10, true);

        let mut master = Master::ended();
        master.is_refused_by(1);
        // Server 0 is still missing, and no other.
        master.waits(0, LATE_MS);
        master.hears(1, TAKEN, 0);
        master.waits(0, LATE_MS);
        master.hears(0, TAKEN, 0);
        master.sends(0, GENERAL);
        master.is_done(0b10, true);
    }

    #[test]
    fn who_is_silent_behind_the_end_is_without_the_data() {
        let mut master = Master::ended();
        master.waits(SILENT_MS - 1, SILENT_MS);
        master.sends(SILENT_MS, TIMED_OUT);
        master.is_done(0b11, true);

        let mut master = Master::ended();
        master.is_refused_by(1);
        master.sends(LATE_MS, TIMED_OUT);
        master.is_done(0b11, true);

        let mut master = Master::ended();
        master.hears(1, TAKEN, 0);
        master.sends(LATE_MS, TIMED_OUT);
        master.is_done(0b01, true);
    }

    #[test]
    fn who_is_silent_behind_the_initiate_ends_the_download_for_all() {
        let mut master = Master::begun();
        master.waits(0, SILENT_MS);
        master.sends(SILENT_MS, TIMED_OUT);
        master.is_done(0b11, false);

        let mut master = Master::begun();
        master.hears(0, granted(127), 100);
        master.waits(100, 100 + LATE_MS);
        // The same answer again puts nothing off.
        master.hears(0, granted(127), 150);
        master.waits(150, 100 + LATE_MS);
        master.sends(100 + LATE_MS, TIMED_OUT);
        master.is_done(0b10, false);
    }

    #[test]
    fn an_answer_for_another_object_or_of_somebody_else_is_none() {
        let mut master = Master::begun_to(0b101);
        for (server, answer) in [
            (0, [0xA4, 0x51, 0x1F, 1, 127, 0, 0, 0]),
            (0, [0xA4, 0x50, 0x1F, 2, 0, 0, 0, 0]),
            (0, acknowledged(1, 127)),
            (0, TAKEN),
            (1, granted(127)),
            (1, granted(0)),
            (1, REFUSED),
        ] {
            master.hears(server, answer, 100);
        }
        master.waits(100, SILENT_MS);
    }

    #[test]
    fn servers_agree_on_a_block_size_from_1_to_127() {
        for (first, second, missing) in [
            (0, None, 0b01),
            (128, None, 0b01),
            (255, None, 0b01),
            (127, Some(0), 0b10),
            (127, Some(126), 0b10),
        ] {
            let mut master = Master::begun();
            master.hears(0, granted(first), 0);
            if let Some(second) = second {
                master.hears(1, granted(second), 0);
            }
            master.sends(0, GENERAL);
            master.is_done(missing, false);

            let mut master = Master::sent();
            master.hears(0, acknowledged(3, first), 0);
            if let Some(second) = second {
                master.hears(1, acknowledged(3, second), 0);
            }
            master.sends(0, GENERAL);
            master.is_done(missing, false);
        }
    }

    /// Who has not got as far as another one stays behind, and is missed at the end.
    #[test]
    fn a_silent_server_holds_up_only_while_another_misses_segments() {
        // Nobody has acknowledged.
        let mut master = Master::sent();
        master.waits(0, SILENT_MS);
        master.sends(SILENT_MS, TIMED_OUT);
        master.is_done(0b11, false);
        // Server 0 has all.
        let mut master = Master::sent();
        master.hears(0, acknowledged(3, 127), 0);
        master.waits(0, LATE_MS);
        master.ends_data(LATE_MS);
        // Server 0 has two of three.
        let mut master = Master::sent();
        master.hears(0, acknowledged(2, 127), 0);
        master.waits(0, SILENT_MS);
        master.sends(SILENT_MS, TIMED_OUT);
        master.is_done(0b10, false);
    }

    /// An acknowledgement of more than was sent is that of the sub-block before, late; and each server
    /// has one.
    #[test]
    fn a_second_or_late_acknowledgement_is_none() {
        let mut master = Master::sent();
        master.hears(0, acknowledged(4, 1), 0);
        master.waits(0, SILENT_MS);
        master.hears(0, acknowledged(3, 127), 0);
        master.hears(0, acknowledged(3, 1), 0);
        master.hears(0, acknowledged(1, 127), 0);
        master.waits(0, LATE_MS);
        master.hears(1, acknowledged(3, 127), 0);
        master.ends_data(0);
    }

    #[test]
    fn each_sub_block_waits_for_all_servers() {
        let mut master = Master::with_blocks_of(2);
        master.sends(0, [1, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55]);
        master.sends(0, [2, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55]);
        master.hears(1, acknowledged(2, 2), 0);
        master.waits(0, LATE_MS);
        master.hears(0, acknowledged(2, 2), 0);
        master.sends(0, [0x81, 0x55, 0x55, 0x55, 0x55, 0x55, 0x55, 0x00]);
        master.waits(0, SILENT_MS);
        master.hears(0, acknowledged(1, 2), 0);
        master.waits(0, LATE_MS);
        master.hears(1, acknowledged(1, 2), 0);
        master.ends_data(0);
    }

    #[test]
    fn the_owner_can_give_up() {
        for mut master in [Master::begun(), Master::sent(), Master::ended()] {
            master.0.abort();
            master.sends(0, GENERAL);
            master.is_done(0b11, false);
        }
    }
}
