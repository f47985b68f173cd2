//! What the masters send: steps of a legal master, whole or broken off, and noise between them.

use attack::device::{Action, Trouble};
use canopen::sdo::client::{Config, Download, SdoError, Step, Transfer};
use canopen::{Address, CobId, Frame, Instant};
use embedded_can::{ExtendedId, Frame as _, StandardId};
use kit::model::Cut;

use super::model::{NO_NODE, RATES};
use super::{is_node_id, Attack, Broken};

/// Objects that noise asks for.
const OBJECTS: [(u16, u8); 16] = [
    (0x1000, 0),
    (0x1003, 1),
    (0x1008, 0),
    (0x1017, 0),
    (0x1018, 4),
    (0x1201, 2),
    (0x1F50, 1),
    (0x1F50, 2),
    (0x1F51, 1),
    (0x1F51, 2),
    (0x1F56, 1),
    (0x1F57, 1),
    (0x2000, 0),
    (0x2006, 1),
    (0x6005, 1),
    (0x7F50, 1),
];
/// Values of 1F51h.
const CONTROLS: [u8; 10] = [0x00, 0x01, 0x02, 0x03, 0x03, 0x80, 0x83, 0x84, 0x7F, 0xFF];
/// The longest time that a client waits in an attack, in ms: an erase takes 2 s.
const CLIENT_MS: u32 = 3000;
/// The longest delay of an activated bit rate, in ms.
const LONGEST_DELAY_MS: u8 = 20;

/// How a transfer goes.
#[derive(Clone, Copy)]
struct Manner {
    /// Percent of noise before each frame.
    noise: usize,
    /// The client stops after so many frames.
    stops_after: u32,
}

const WHOLE: Manner = Manner { noise: 0, stops_after: u32::MAX };

impl Attack {
    /// Some steps and noise.
    pub(super) fn attack(&mut self) -> Result<(), Broken> {
        if self.random.chance(6) {
            let operation = self.random.pick(&[0, 1, 5, 40, 700]);
            if self.random.chance(50) {
                let operation = operation + self.random.below(9) as u32;
                let cut = Cut::Torn(self.summary.bursts);
                self.target.act(&Action::Flash(operation, Trouble::Cut(cut)));
            } else {
                self.was_cut = true;
                self.pass(1000)?;
            }
        }
        if self.random.chance(3) {
            let errors = self.random.pick(&[1, 10, 33, 70]);
            self.tell(format!("{errors} frames of the device are destroyed"));
            self.was_disturbed = true;
            self.target.act(&Action::Disturb(errors));
        }
        for _ in 0..1 + self.random.below(6) {
            match self.random.below(16) {
                0 => self.update()?,
                1 => self.control()?,
                2 => self.configure()?,
                3 => self.find()?,
                4 => self.second_server()?,
                5 => self.nmt()?,
                6 => self.read_something()?,
                7 => self.unlock()?,
                8..=9 => self.flood()?,
                _ => {
                    for _ in 0..1 + self.random.below(60) {
                        self.noise()?;
                    }
                }
            }
        }
        Ok(())
    }

    // --- a legal master

    /// Runs a client; returns its result, or nothing if it stopped before.
    fn transfer(
        &mut self,
        master: usize,
        mut client: Download<Vec<u8>>,
        manner: Manner,
    ) -> Result<Option<Result<(), SdoError>>, Broken> {
        self.drain()?;
        self.heard.clear();
        let mut sent = 0;
        loop {
            let now = Instant::from_millis((self.target.now_us() / 1000) as u32);
            while let Some(frame) = self.heard.pop_front() {
                client.handle(&frame, now);
            }
            match client.poll(now) {
                Step::Send(frame) => {
                    if self.random.chance(manner.noise) {
                        self.noise()?;
                    }
                    sent += 1;
                    if sent > manner.stops_after {
                        return Ok(None);
                    }
                    self.send(master, &frame);
                    // A client of blocks sends without waiting; the queue of the port is no memory.
                    if sent % 64 == 0 {
                        self.drain()?;
                    }
                }
                Step::Wait(_) => self.pass(500)?,
                Step::Done(result) => return Ok(Some(result)),
            }
        }
    }

    fn download(&mut self, at: Address, data: Vec<u8>) -> Download<Vec<u8>> {
        let config = Config { timeout_ms: CLIENT_MS };
        if self.random.chance(80) {
            Download::as_blocks(self.node(), at, data, config)
        } else {
            Download::new(self.node(), at, data, config)
        }
    }

    fn write(&mut self, at: Address, data: Vec<u8>, manner: Manner) -> Result<bool, Broken> {
        let client = self.download(at, data);
        let master = self.random.below(2);
        Ok(matches!(self.transfer(master, client, manner)?, Some(Ok(()))))
    }

    fn program(&mut self) -> u8 {
        1 + self.random.below(self.setup.layout.programs.len()) as u8
    }

    /// Waits until 1F57h is not busy.
    fn await_idle(&mut self, program: u8) -> Result<(), Broken> {
        for _ in 0..200 {
            let answer = self.ask([0x40, 0x57, 0x1F, program, 0, 0, 0, 0], self.target.answer_us())?;
            match answer {
                Some([0x43, _, _, _, status, ..]) if status & 1 == 1 => self.pass(20_000)?,
                _ => break,
            }
        }
        Ok(())
    }

    /// An update: whole, with noise in it, or broken off.
    fn update(&mut self) -> Result<(), Broken> {
        let image = self.random.below(self.setup.images.len());
        let image = self.setup.images[image].clone();
        self.tell(format!("an update of program {}", image.program));
        let manner = match self.random.below(4) {
            0 => Manner { noise: 3, ..WHOLE },
            1 => Manner { stops_after: 1 + self.random.below(400) as u32, ..WHOLE },
            _ => WHOLE,
        };
        if self.is_app {
            self.write(Address::new(0x1F51, 1), vec![0x80], WHOLE)?;
            self.pass(100_000)?;
        }
        self.unlock_program(image.program)?;
        self.write(Address::new(0x1F51, image.program), vec![0x03], WHOLE)?;
        self.await_idle(image.program)?;
        let data = Address::new(0x1F50, image.program);
        // A raw image has no check of its own: noise in it would be a part of it.
        let downloads = if manner.noise == 0 && manner.stops_after == u32::MAX && self.random.chance(25) {
            vec![image.whole]
        } else {
            image.blocks
        };
        for download in downloads {
            if !self.write(data, download, manner)? {
                return Ok(());
            }
            if self.random.chance(2) {
                return Ok(());
            }
        }
        self.await_idle(image.program)?;
        self.summary.updates += 1;
        if self.random.chance(70) {
            self.write(Address::new(0x1F51, image.program), vec![0x83], WHOLE)?;
            self.await_idle(image.program)?;
        }
        if self.random.chance(70) {
            self.leave(image.program, 0x01)?;
        }
        Ok(())
    }

    fn unlock_program(&mut self, program: u8) -> Result<(), Broken> {
        if let Some((index, password)) = self.setup.password {
            let sub = if index == 0x6005 { 1 } else { program };
            self.write(Address::new(index, sub), password.to_vec(), WHOLE)?;
            self.await_idle(program)?;
        }
        Ok(())
    }

    /// A password, right or wrong.
    fn unlock(&mut self) -> Result<(), Broken> {
        let program = self.program();
        if self.random.chance(50) {
            return self.unlock_program(program);
        }
        let wrong = self.random.next().to_le_bytes()[..4].to_vec();
        let index = self.random.pick(&[0x7F50, 0x6005]);
        self.write(Address::new(index, program), wrong, WHOLE).map(drop)
    }

    /// A value of 1F51h after which the device may leave.
    fn leave(&mut self, program: u8, value: u8) -> Result<(), Broken> {
        self.write(Address::new(0x1F51, program), vec![value], WHOLE)?;
        self.await_reset()
    }

    /// A reset that was asked for comes, and the device starts.
    fn await_reset(&mut self) -> Result<(), Broken> {
        let resets = self.summary.resets;
        for _ in 0..100 {
            self.pass(2000)?;
            if self.summary.resets > resets {
                return self.pass(60_000);
            }
        }
        Ok(())
    }

    fn control(&mut self) -> Result<(), Broken> {
        let program = self.program();
        let value = self.random.pick(&CONTROLS);
        self.leave(program, value)?;
        // The second CLEAR in a row erases at once.
        if value == 0x03 && self.random.chance(70) {
            return self.leave(program, value);
        }
        Ok(())
    }

    /// LSS: node-ID and bit rate, stored or not.
    fn configure(&mut self) -> Result<(), Broken> {
        self.tell("LSS configures".into());
        if self.random.chance(50) {
            self.lss([0x04, 1, 0, 0, 0, 0, 0, 0], 0)?;
        } else {
            for (step, part) in (0x40..).zip(self.model.address()) {
                let [a, b, c, d] = part.to_le_bytes();
                self.lss([step, a, b, c, d, 0, 0, 0], 0)?;
            }
        }
        let id = match self.random.below(8) {
            0 => NO_NODE,
            1 => self.random.below(256) as u8,
            _ => 1 + self.random.below(127) as u8,
        };
        self.lss([0x11, id, 0, 0, 0, 0, 0, 0], self.target.answer_us())?;
        if self.random.chance(30) {
            let (rate, _) = self.random.pick(&RATES);
            self.lss([0x13, 0, rate, 0, 0, 0, 0, 0], self.target.answer_us())?;
        }
        if self.random.chance(50) {
            self.lss([0x17, 0, 0, 0, 0, 0, 0, 0], 200_000)?;
        }
        for inquiry in 0x5A..=0x5E {
            self.lss([inquiry, 0, 0, 0, 0, 0, 0, 0], 0)?;
        }
        self.lss([0x04, 0, 0, 0, 0, 0, 0, 0], 0)?;
        if self.random.chance(60) {
            let command = self.random.pick(&[0x81, 0x82]);
            self.nmt_command(command, 0)?;
        }
        Ok(())
    }

    /// LSS: fastscan, and identification.
    fn find(&mut self) -> Result<(), Broken> {
        self.tell("LSS scans".into());
        let address = self.model.address();
        self.lss([0x4C, 0, 0, 0, 0, 0, 0, 0], 5000)?;
        self.lss([0x51, 0, 0, 0, 0, 0x80, 0, 0], 5000)?;
        for (part, number) in (0..).zip(address) {
            let [a, b, c, d] = number.to_le_bytes();
            let bit = self.random.below(33) as u8;
            self.lss([0x51, a, b, c, d, bit, part, part], 2000)?;
            self.lss([0x51, a, b, c, d, 0, part, (part + 1) % 4], 2000)?;
        }
        let [vendor, product, revision, serial] = address.map(u32::to_le_bytes);
        for (step, [a, b, c, d]) in (0x46..).zip([vendor, product, revision, revision, serial, serial]) {
            self.lss([step, a, b, c, d, 0, 0, 0], 2000)?;
        }
        self.lss([0x04, 0, 0, 0, 0, 0, 0, 0], 0).map(drop)
    }

    /// 1201h: other COB-IDs, and requests to them.
    fn second_server(&mut self) -> Result<(), Broken> {
        let request: u16 = self.random.pick(&[0x181, 0x300, 0x57F, 0x680, 0x6DF, 0x601, 0x000, 0x7E5]);
        let response: u16 = self.random.pick(&[0x182, 0x301, 0x681, 0x581, 0x080]);
        for (sub, id) in [(1, request), (2, response)] {
            self.write(Address::new(0x1201, sub), 0x8000_0000_u32.to_le_bytes().to_vec(), WHOLE)?;
            let value = u32::from(id);
            self.write(Address::new(0x1201, sub), value.to_le_bytes().to_vec(), WHOLE)?;
        }
        for _ in 0..self.random.below(10) {
            let bytes = self.sdo_bytes();
            if let Some(id) = CobId::new(request) {
                self.put(Frame::full(id, bytes))?;
            }
        }
        Ok(())
    }

    fn nmt_command(&mut self, command: u8, node: u8) -> Result<(), Broken> {
        self.put(Frame::of(CobId::NMT, &[command, node]))
    }

    fn nmt(&mut self) -> Result<(), Broken> {
        let command = self.random.pick(&[0x01, 0x02, 0x80, 0x81, 0x82]);
        let own = self.node().get();
        let node = self.random.pick(&[0, own, own ^ 1]);
        self.nmt_command(command, node)
    }

    fn read_something(&mut self) -> Result<(), Broken> {
        let (index, sub) = self.random.pick(&OBJECTS);
        let [low, high] = index.to_le_bytes();
        let command = self.random.pick(&[0x40, 0xA0, 0xA4]);
        self.ask([command, low, high, sub, 127, 0, 0, 0], self.target.answer_us())?;
        for _ in 0..self.random.below(8) {
            let next = self.random.pick(&[0x60, 0x70, 0xA3, 0xA2, 0xA1]);
            let size = self.random.below(128) as u8;
            self.put(self.sdo([next, size, 127, 0, 0, 0, 0, 0]))?;
        }
        Ok(())
    }

    // --- noise

    /// Sends a frame. What must not be mixed with others, because the order on the bus decides, waits.
    fn put(&mut self, frame: Frame) -> Result<(), Broken> {
        let id = frame.cob_id().map(CobId::get);
        let is_strict = matches!(id, Some(0x000 | 0x7E5));
        if is_strict {
            self.clear_doubt()?;
        }
        if !self.is_tame(&frame) {
            return Ok(());
        }
        let master = self.random.below(2);
        self.send(master, &frame);
        if !is_strict {
            return self.pass(self.gap());
        }
        self.drain()?;
        match (id, frame.data()) {
            (Some(0x000), &[0x81, _]) => self.await_reset(),
            (Some(0x000), &[0x82, _]) => self.pass(10_000),
            (Some(0x7E5), &[0x17, ..]) => self.pass(100_000),
            (Some(0x7E5), &[0x15, ..]) => {
                while self.target.now_us() < self.model.silent_until() {
                    self.pass(1000)?;
                }
                self.target.set_bit_rate(self.model.bit_rate());
                self.pass(2000)
            }
            _ => self.pass(1000),
        }
    }

    fn gap(&self) -> u64 {
        // Some frames are sent back to back, others wait for the answer.
        [0, 0, 0, 200, 1500][self.summary.frames as usize % 5]
    }

    /// Whether the attack can follow what comes of this frame: a bus at 10 kbit/s, or a device that
    /// is silent for a minute, would cost time and find nothing.
    fn is_tame(&self, frame: &Frame) -> bool {
        if frame.cob_id() != Some(CobId::LSS_REQUEST) || !self.model.configures() {
            return true;
        }
        match frame.data() {
            [0x13, table, rate, ..] => *table != 0 || RATES.iter().any(|(index, _)| index == rate),
            [0x15, low, high, ..] => *low <= LONGEST_DELAY_MS && *high == 0,
            _ => true,
        }
    }

    /// Eight bytes that look like a request of SDO.
    fn sdo_bytes(&mut self) -> [u8; 8] {
        let (index, sub) = self.random.pick(&OBJECTS);
        let [low, high] = index.to_le_bytes();
        let [a, b, c, d, e, ..] = self.random.next().to_le_bytes();
        let value = if index == 0x1F51 { self.random.pick(&CONTROLS) } else { a };
        let command = match self.random.below(6) {
            0..=1 => 0x40,
            2 => self.random.pick(&[0x2F, 0x2B, 0x27, 0x23, 0x22, 0x21, 0x20]),
            3 => self.random.pick(&[0xA0, 0xA4, 0xC0, 0xC2, 0xC4, 0xC6]),
            4 => self.random.pick(&[0x80, 0x00, 0x10, 0x60, 0x70, 0xA1, 0xA2, 0xA3, 0xC1]),
            _ => e,
        };
        [command, low, high, sub, value, b, c, d]
    }

    /// A frame of a legal master.
    fn nearly(&mut self) -> Frame {
        let program = self.program();
        let node = self.node().get();
        let lss = |bytes: [u8; 8]| Frame::full(CobId::LSS_REQUEST, bytes);
        let id = self.random.below(256) as u8;
        match self.random.below(10) {
            0..=2 => {
                let value = self.random.pick(&[0x03, 0x01, 0x84, 0x80]);
                self.sdo([0x2F, 0x51, 0x1F, program, value, 0, 0, 0])
            }
            3 => self.sdo([0x21, 0x50, 0x1F, program, 0, 1, 0, 0]),
            4 => Frame::of(CobId::NMT, &[0x81, self.random.pick(&[0, node])]),
            5 => Frame::of(CobId::NMT, &[0x82, self.random.pick(&[0, node])]),
            6 => lss([0x04, 1, 0, 0, 0, 0, 0, 0]),
            7 => lss([0x11, if is_node_id(id) { id } else { 7 }, 0, 0, 0, 0, 0, 0]),
            8 => lss([0x17, 0, 0, 0, 0, 0, 0, 0]),
            _ => lss([0x5A + id % 5, 0, 0, 0, 0, 0, 0, 0]),
        }
    }

    /// That frame with one fault, so that it is none: another length, 29 bits, RTR, another node.
    fn flawed(&mut self) -> Frame {
        let frame = self.nearly();
        let id = frame.cob_id().map_or(0, CobId::get);
        let data = frame.data();
        let standard = |id: u16| StandardId::new(id).unwrap_or(StandardId::MAX);
        let short = self.random.below(data.len());
        let other = 1 + self.random.below(126) as u16;
        let made = match self.random.below(6) {
            0..=1 => Frame::new(standard(id), &data[..short]),
            2 => Frame::new(ExtendedId::new(u32::from(id)).unwrap_or(ExtendedId::ZERO), data),
            3 => Frame::new(ExtendedId::new(u32::from(id) << 18).unwrap_or(ExtendedId::ZERO), data),
            4 => Frame::new_remote(standard(id), data.len()),
            _ if id >= 0x600 => {
                let base = id & 0x780;
                Frame::new(standard(base | (id & 0x7F).wrapping_add(other) & 0x7F), data)
            }
            // Longer.
            _ => Frame::new(standard(id), &[data, &[0][..]].concat()),
        };
        made.unwrap_or(frame)
    }

    /// Any frame.
    fn random_frame(&mut self) -> Frame {
        let bytes = self.random.next().to_le_bytes();
        let len = self.random.below(9);
        let own = u16::from(self.node().get());
        let id = match self.random.below(8) {
            0 => 0x600 + own,
            1 => self.random.pick(&[0x000, 0x080, 0x580 + own, 0x700 + own, 0x7E4]),
            2 => 0x7E5,
            _ => self.random.below(0x800) as u16,
        };
        let standard = StandardId::new(id).unwrap_or(StandardId::MAX);
        let made = match self.random.below(10) {
            0 => Frame::new_remote(standard, len),
            1 | 2 => {
                let id = self.random.below(1 << 29) as u32;
                Frame::new(ExtendedId::new(id).unwrap_or(ExtendedId::ZERO), &bytes[..len])
            }
            _ => Frame::new(standard, &bytes[..len]),
        };
        made.unwrap_or(Frame::of(CobId::NMT, &[]))
    }

    fn noise(&mut self) -> Result<(), Broken> {
        if self.random.chance(10) {
            self.target.act(&Action::Scramble(self.summary.frames));
        }
        let frame = match self.random.below(8) {
            0..=2 => self.random_frame(),
            3..=5 => self.flawed(),
            6 => {
                let bytes = self.sdo_bytes();
                self.sdo(bytes)
            }
            _ => self.nearly(),
        };
        self.put(frame)
    }

    /// The same frames, or requests, without a gap between them.
    fn flood(&mut self) -> Result<(), Broken> {
        let count = 20 + self.random.below(400);
        self.tell(format!("{count} frames without a gap"));
        let requests = self.random.chance(50);
        let mut frames = Vec::new();
        for _ in 0..4 {
            let frame = if requests {
                let bytes = self.sdo_bytes();
                self.sdo(bytes)
            } else {
                self.flawed()
            };
            // What the device may obey is not sent in a flood of which it may lose frames.
            if !matches!(frame.cob_id().map(CobId::get), Some(0x000 | 0x7E5)) {
                frames.push(frame);
            }
        }
        for frame in frames.iter().cycle().take(if frames.is_empty() { 0 } else { count }) {
            let master = self.random.below(2);
            self.send(master, frame);
        }
        self.drain()
    }
}
