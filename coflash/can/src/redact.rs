//! Removes passwords, and programs, from frames, for records that users pass on.

use std::collections::BTreeMap;

use canopen::debugger::DEBUGGER;
use canopen::program::PROGRAM_DATA;
use canopen::{Address, Frame};
use embedded_can::{Frame as _, Id};

/// The objects to which passwords are written: the access code of CiA 814-1, and the password of
/// ESAcademy's bootloader.
const PASSWORDS: [u16; 2] = [0x6005, 0x7F50];

/// The objects through which programs and memory are transferred, in both directions.
const CONTENTS: [u16; 2] = [PROGRAM_DATA, DEBUGGER];

/// Whether data written to this object are a password.
#[must_use]
pub fn is_password(at: Address) -> bool {
    PASSWORDS.contains(&at.index)
}

/// Replaces the bytes of passwords by 0 in SDO downloads of every form; a redactor
/// [of contents](Redactor::of_contents) also those of programs.
///
/// A product may have COB-IDs of its own for SDO, and a record does not say which: a frame on any COB-ID may be a
/// request, and what names the object of a request is its answer.
///
/// A record may begin in the middle of a transfer, of which nothing tells the object: on the COB-IDs of the
/// predefined connection set, what may be its data is removed, too, until a transfer begins. On the COB-IDs of a
/// product such frames are like any process data, and stay.
#[derive(Debug, Default)]
pub struct Redactor {
    /// Whether programs and memory are removed, too.
    contents: bool,
    /// The transfers of something that is removed, by the COB-ID of their requests.
    under_way: BTreeMap<u16, Transfer>,
    /// The COB-IDs of answers, with those of their requests.
    answers: BTreeMap<u16, u16>,
    /// What is known of the transfers of each node, by the predefined COB-ID of its requests.
    channels: BTreeMap<u16, Channel>,
}

/// The SDO channel of a node: whether the transfer under way has an object that was seen.
#[derive(Clone, Copy, Debug)]
enum Channel {
    /// No frame yet has begun a transfer for certain: what looks like the beginning may be a segment of a block
    /// with that number.
    Open {
        /// The COB-ID of the latest frame.
        id: u16,
        /// Its first byte.
        first: u8,
        is_beginning: bool,
    },
    /// A transfer has begun, or ended with an abort.
    Known,
}

#[derive(Clone, Copy, Debug)]
struct Transfer {
    form: Form,
    /// Index and sub-index, as in the frame.
    object: [u8; 3],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    Segments,
    Blocks,
    /// The node sends the data, in any form.
    Upload,
}

impl Redactor {
    /// A redactor that also removes programs and memory, which are data of 1F50h and of the debugger
    /// interface, in downloads and uploads.
    #[must_use]
    pub fn of_contents() -> Self {
        Self { contents: true, ..Self::default() }
    }

    /// Returns the frame in a form that may be shown. Frames must be passed in the order of the
    /// bus.
    pub fn frame(&mut self, frame: &Frame) -> Frame {
        let Id::Standard(id) = frame.id() else { return *frame };
        let (id, data) = (id.as_raw(), frame.data());
        let Some(first) = data.first() else { return *frame };
        let is_unseen = self.is_of_unseen(id, *first);
        match self.request_of(id, data) {
            Some(request) => self.answer(frame, request, *first),
            None if is_unseen && !self.under_way.contains_key(&id) => without(frame, 1),
            None => self.request(frame, id, *first),
        }
    }

    /// Whether a frame may have data of a transfer whose beginning was not seen.
    fn is_of_unseen(&mut self, id: u16, first: u8) -> bool {
        // CiA 301, the predefined connection set.
        let request = match (id & 0x780, id & 0x7F) {
            (_, 0) => return false,
            (0x600, _) => id,
            (0x580, _) => id + 0x80,
            _ => return false,
        };
        // The segments of a block follow each other without an answer; all other frames are answered.
        let (is_next, was_beginning) = match self.channels.get(&request) {
            Some(Channel::Known) => return false,
            Some(Channel::Open { id: latest, first: number, is_beginning }) => {
                ((*latest, number.wrapping_add(1) & 0x7F) == (id, first & 0x7F), *is_beginning)
            }
            None => (false, false),
        };
        let is_abort = first == 0x80;
        if is_abort || (was_beginning && !is_next) {
            self.channels.insert(request, Channel::Known);
            return false;
        }
        // What is neither a segment nor an acknowledgement names an object, or has no data.
        let has_no_data = matches!((first >> 5, first & 3), (1..=3, _) | (5, 0) | (6, 0 | 2)) && !is_next;
        let is_beginning = has_no_data && id == request && begins(first);
        self.channels.insert(request, Channel::Open { id, first, is_beginning });
        !has_no_data && (self.contents || id == request)
    }

    /// The COB-ID of the request that a frame answers, if a transfer of something that is removed is under way
    /// there.
    fn request_of(&mut self, id: u16, data: &[u8]) -> Option<u16> {
        // CiA 301, the predefined connection set.
        let predefined = (id & 0x780 == 0x580).then_some(id + 0x80);
        let known = self.answers.get(&id).copied().or(predefined);
        if let Some(request) = known.filter(|request| self.under_way.contains_key(request)) {
            return Some(request);
        }
        let answers = |transfer: &Transfer| match transfer.form {
            Form::Segments | Form::Blocks => matches!(data[0] >> 5, 3 | 5),
            Form::Upload => matches!(data[0] >> 5, 2 | 6),
        };
        let object = data.get(1..4)?;
        let is_asked = |(request, transfer): &(&u16, &Transfer)| {
            **request != id && transfer.object == object && (data[0] == 0x80 || answers(transfer))
        };
        let request = *self.under_way.iter().find(is_asked)?.0;
        self.answers.insert(id, request);
        Some(request)
    }

    fn answer(&mut self, frame: &Frame, request: u16, first: u8) -> Frame {
        let is_upload = self.under_way.get(&request).is_some_and(|transfer| transfer.form == Form::Upload);
        if is_upload && first != 0x80 {
            // The first answer repeats the object, and may already have up to four bytes.
            let begins = first >> 5 == 2 && self.has_contents(frame.data());
            return without(frame, if begins { 4 } else { 1 });
        }
        // An abort, or the answer to the end of a block download.
        if first == 0x80 || first & 0xE3 == 0xA1 {
            self.under_way.remove(&request);
        }
        *frame
    }

    fn request(&mut self, frame: &Frame, id: u16, first: u8) -> Frame {
        let data = frame.data();
        let contents = self.has_contents(data);
        let secret = contents || has(data, &PASSWORDS);
        let object = data.get(1..4).and_then(|object| object.try_into().ok()).unwrap_or_default();
        let begins = begins(first);
        let under_way = self.under_way.get(&id).map(|transfer| transfer.form);
        let mut begin = |form| {
            self.under_way.insert(id, Transfer { form, object });
        };
        match (under_way, first >> 5) {
            // Requests for more of an upload have no data.
            (Some(Form::Upload), _) if first != 0x80 && !begins => *frame,
            (_, 0b100) if first == 0x80 => {
                self.under_way.remove(&id);
                *frame
            }
            (Some(Form::Blocks), _) => without(frame, 1),
            (Some(Form::Segments), 0) => {
                if first & 1 != 0 {
                    self.under_way.remove(&id);
                }
                without(frame, 1)
            }
            (_, 1) if secret && first & 2 != 0 => {
                self.under_way.remove(&id);
                without(frame, 4)
            }
            (_, 1) if secret => {
                begin(Form::Segments);
                *frame
            }
            (_, 6) if secret && first & 1 == 0 => {
                begin(Form::Blocks);
                *frame
            }
            (_, 2 | 5) if contents => {
                begin(Form::Upload);
                *frame
            }
            _ => {
                self.under_way.remove(&id);
                *frame
            }
        }
    }

    fn has_contents(&self, data: &[u8]) -> bool {
        self.contents && has(data, &CONTENTS)
    }
}

/// Whether a request with this first byte begins a transfer.
fn begins(first: u8) -> bool {
    matches!((first >> 5, first & 3), (1 | 2, _) | (5, 0) | (6, 0 | 2))
}

/// Whether an SDO frame names one of these objects.
fn has(data: &[u8], objects: &[u16]) -> bool {
    data.len() >= 3 && objects.contains(&u16::from_le_bytes([data[1], data[2]]))
}

/// The frame with zeros from byte `from` on.
fn without(frame: &Frame, from: usize) -> Frame {
    let mut data = frame.data().to_vec();
    data.iter_mut().skip(from).for_each(|byte| *byte = 0);
    Frame::new(frame.id(), &data).unwrap_or(*frame)
}

#[cfg(test)]
mod tests {
    use embedded_can::StandardId;

    use super::*;

    fn shown(frames: &[(bool, [u8; 8])]) -> Vec<[u8; 8]> {
        shown_by(Redactor::default, frames)
    }

    /// The frames as they are shown: with the predefined COB-IDs, and the same with those of a product.
    fn shown_by(redactor: fn() -> Redactor, frames: &[(bool, [u8; 8])]) -> Vec<[u8; 8]> {
        let shown = [(0x605, 0x585), (0x5FE, 0x67D), (0x285, 0x385)].map(|(request, response)| {
            let mut redactor = redactor();
            let id = |to_node| StandardId::new(if to_node { request } else { response }).unwrap();
            let frames = frames.iter().map(|(to_node, data)| Frame::new(id(*to_node), data).unwrap());
            frames.map(|frame| redactor.frame(&frame).data().try_into().unwrap()).collect::<Vec<_>>()
        });
        assert!(shown.iter().all(|other| *other == shown[0]), "{shown:?}");
        let [shown, ..] = shown;
        shown
    }

    #[test]
    fn a_password_is_not_in_what_is_shown() {
        // CiA 301: expedited, segmented, and block download; the data of the next object are shown.
        let after = (true, [0x2F, 0x51, 0x1F, 1, 0x80, 0, 0, 0]);
        let cases: [&[(bool, [u8; 8])]; 3] = [
            &[
                (true, [0x23, 0x50, 0x7F, 1, b'I', b'N', b'I', b'T']),
                (false, [0x60, 0x50, 0x7F, 1, 0, 0, 0, 0]),
            ],
            &[
                (true, [0x21, 0x05, 0x60, 1, 10, 0, 0, 0]),
                (false, [0x60, 0x05, 0x60, 1, 0, 0, 0, 0]),
                (true, [0x00, b'o', b'p', b'e', b'n', b's', b'e', b's']),
                (false, [0x20, 0, 0, 0, 0, 0, 0, 0]),
                (true, [0x19, b'a', b'm', b'e', 0, 0, 0, 0]),
            ],
            &[
                (true, [0xC6, 0x05, 0x60, 1, 10, 0, 0, 0]),
                (false, [0xA4, 0x05, 0x60, 1, 127, 0, 0, 0]),
                (true, [0x01, b'o', b'p', b'e', b'n', b's', b'e', b's']),
                (true, [0x82, b'a', b'm', b'e', 0, 0, 0, 0]),
                (false, [0xA2, 2, 127, 0, 0, 0, 0, 0]),
                (true, [0xD1, 0x12, 0x34, 0, 0, 0, 0, 0]),
                (false, [0xA1, 0, 0, 0, 0, 0, 0, 0]),
            ],
        ];
        for case in cases {
            let all = shown(&[case, &[after]].concat());
            let letters =
                all.iter().flat_map(|data| &data[1..]).filter(|byte| byte.is_ascii_lowercase()).count();
            assert_eq!(letters, 0, "{all:?}");
            assert!(!all.iter().any(|data| data[4..] == *b"INIT"), "{all:?}");
            assert_eq!(all.last(), Some(&after.1));
            assert_eq!(all[0][..4], case[0].1[..4]);
        }
    }

    /// CiA 301: downloads to 1F50h in segments and blocks, uploads from it expedited, in segments and
    /// blocks. The number of a block's segment may be equal to a command.
    #[test]
    fn a_program_is_not_in_what_a_redactor_of_contents_shows() {
        const P: u8 = 0xEE;
        let cases: [&[(bool, [u8; 8])]; 5] = [
            &[
                (true, [0x21, 0x50, 0x1F, 1, 7, 0, 0, 0]),
                (false, [0x60, 0x50, 0x1F, 1, 0, 0, 0, 0]),
                (true, [0x01, P, P, P, P, P, P, P]),
            ],
            &[
                (true, [0xC6, 0x50, 0x1F, 1, 14, 0, 0, 0]),
                (false, [0xA4, 0x50, 0x1F, 1, 127, 0, 0, 0]),
                (true, [0x21, P, P, P, P, P, P, P]),
                (true, [0xA2, P, P, P, P, P, P, P]),
                (false, [0xA2, 2, 127, 0, 0, 0, 0, 0]),
                (true, [0xC1, 0, 0, 0, 0, 0, 0, 0]),
                (false, [0xA1, 0, 0, 0, 0, 0, 0, 0]),
            ],
            &[(true, [0x40, 0x50, 0x1F, 1, 0, 0, 0, 0]), (false, [0x43, 0x50, 0x1F, 1, P, P, P, P])],
            &[
                (true, [0x40, 0x25, 0x10, 2, 0, 0, 0, 0]),
                (false, [0x41, 0x25, 0x10, 2, 14, 0, 0, 0]),
                (true, [0x60, 0, 0, 0, 0, 0, 0, 0]),
                (false, [0x00, P, P, P, P, P, P, P]),
                (true, [0x70, 0, 0, 0, 0, 0, 0, 0]),
                (false, [0x11, P, P, P, P, P, P, P]),
            ],
            &[
                (true, [0xA4, 0x50, 0x1F, 1, 127, 0, 0, 0]),
                (false, [0xC6, 0x50, 0x1F, 1, 14, 0, 0, 0]),
                (true, [0xA3, 0, 0, 0, 0, 0, 0, 0]),
                (false, [0x43, P, P, P, P, P, P, P]),
                (false, [0xA1, P, P, P, P, P, P, P]),
                (true, [0xA2, 2, 127, 0, 0, 0, 0, 0]),
                (false, [0xC1, 0, 0, 0, 0, 0, 0, 0]),
                (true, [0xA1, 0, 0, 0, 0, 0, 0, 0]),
            ],
        ];
        let after = [(true, [0x40, 0, 0x10, 0, 0, 0, 0, 0]), (false, [0x43, 0, 0x10, 0, P, 1, 0, 0])];
        for case in cases {
            let all = shown_by(Redactor::of_contents, &[case, &after].concat());
            let (of_case, of_after) = all.split_at(case.len());
            assert!(!of_case.as_flattened().contains(&P), "{of_case:?}");
            assert_eq!(of_after, after.map(|(_, data)| data));
            assert_eq!(of_case[0], case[0].1);
            // Where only passwords are removed, the program stays.
            assert_eq!(shown(case), case.iter().map(|(_, data)| *data).collect::<Vec<_>>());
        }
    }

    /// The frames as a record shows them that begins with the first of them.
    fn recorded(redactor: fn() -> Redactor, frames: &[(bool, [u8; 8])]) -> Vec<[u8; 8]> {
        let mut redactor = redactor();
        let of = |(to_node, data): &(bool, [u8; 8])| {
            let id = StandardId::new(if *to_node { 0x605 } else { 0x585 }).unwrap();
            redactor.frame(&Frame::new(id, data).unwrap()).data().try_into().unwrap()
        };
        frames.iter().map(of).collect()
    }

    const S: u8 = 0xEE;

    /// CiA 301: what comes after the request and the answer that name the object, from each frame on.
    #[test]
    fn a_password_is_not_in_a_record_that_begins_within_its_transfer() {
        let segments = [
            (true, [0x00, S, S, S, S, S, S, S]),
            (false, [0x20, 0, 0, 0, 0, 0, 0, 0]),
            (true, [0x10, S, S, S, S, S, S, S]),
            (false, [0x30, 0, 0, 0, 0, 0, 0, 0]),
            (true, [0x0B, S, S, 0, 0, 0, 0, 0]),
            (false, [0x20, 0, 0, 0, 0, 0, 0, 0]),
        ];
        let blocks = [
            (true, [0x01, S, S, S, S, S, S, S]),
            (true, [0x02, S, S, S, S, S, S, S]),
            (true, [0x83, S, S, S, S, S, S, S]),
            (false, [0xA2, 3, 127, 0, 0, 0, 0, 0]),
            (true, [0xC1, S, S, 0, 0, 0, 0, 0]),
            (false, [0xA1, 0, 0, 0, 0, 0, 0, 0]),
        ];
        // Without a password: an upload in two forms, and a download in segments.
        let after = [
            (true, [0x40, 0, 0x10, 0, 0, 0, 0, 0]),
            (false, [0x43, 0, 0x10, 0, 0x92, 1, 2, 0]),
            (true, [0x40, 8, 0x10, 0, 0, 0, 0, 0]),
            (false, [0x41, 8, 0x10, 0, 9, 0, 0, 0]),
            (true, [0x60, 0, 0, 0, 0, 0, 0, 0]),
            (false, [0x00, b'c', b'o', b'b', b'o', b'o', b't', b' ']),
            (true, [0x21, 0x0A, 0x10, 1, 7, 0, 0, 0]),
            (false, [0x60, 0x0A, 0x10, 1, 0, 0, 0, 0]),
            (true, [0x01, b'v', b'e', b'r', b's', b'i', b'o', b'n']),
        ];
        for transfer in [segments, blocks] {
            for begin in 0..transfer.len() {
                let rest = &transfer[begin..];
                for redactor in [Redactor::default, Redactor::of_contents] {
                    let all = recorded(redactor, &[rest, &after].concat());
                    let (of_rest, of_after) = all.split_at(rest.len());
                    assert!(!of_rest.as_flattened().contains(&S), "{begin}: {of_rest:02X?}");
                    assert!(of_rest.iter().zip(rest).all(|(shown, (_, data))| shown[0] == data[0]));
                    assert_eq!(of_after, after.map(|(_, data)| data), "{begin}");
                }
            }
        }
        // The answer alone names the object, and then the segments come.
        let answered = [(false, [0x60, 0x05, 0x60, 1, 0, 0, 0, 0])];
        let all = recorded(Redactor::default, &[&answered[..], &segments].concat());
        assert!(!all.as_flattened().contains(&S) && all[0] == answered[0].1, "{all:02X?}");
        // An abort ends the transfer.
        let aborted = [segments[0], (false, [0x80, 0, 0, 0, 0, 0, 4, 5]), segments[2]];
        assert_eq!(recorded(Redactor::default, &aborted)[1..], [aborted[1].1, aborted[2].1]);
    }

    /// The numbers of a block's segments are the commands of other requests, and the other nodes have transfers of
    /// their own.
    #[test]
    fn a_program_is_not_in_a_record_that_begins_within_its_blocks() {
        for to_node in [true, false] {
            for begin in [0x01, 0x1F, 0x3E, 0x41, 0x58, 0x5F] {
                let block: Vec<_> =
                    (begin..=0x7F).map(|number| (to_node, [number, S, S, S, S, S, S, S])).collect();
                let all = recorded(Redactor::of_contents, &block);
                // The first one alone may be a request that names its object.
                assert!(!all[1..].as_flattened().contains(&S), "{to_node} {begin:X}: {all:02X?}");
            }
        }
        let mut redactor = Redactor::default();
        let mut shown = |id, data: [u8; 8]| {
            let frame = Frame::new(StandardId::new(id).unwrap(), &data).unwrap();
            redactor.frame(&frame).data().to_vec()
        };
        let (read, segment) = ([0x40, 0, 0x10, 0, 0, 0, 0, 0], [0x00, S, S, S, S, S, S, S]);
        assert_eq!(shown(0x606, read), read);
        assert_eq!(shown(0x605, segment), [0; 8]);
        // Process data, emergencies and the other services have no transfers.
        for id in [0x000, 0x080, 0x085, 0x185, 0x585, 0x600, 0x705, 0x7E5] {
            assert_eq!(shown(id, segment), segment, "{id:X}");
        }
    }

    #[test]
    fn what_is_no_password_is_shown_as_it_is() {
        let frames = [
            (true, [0x21, 0x50, 0x1F, 1, 10, 0, 0, 0]),
            (true, [0x00, 1, 2, 3, 4, 5, 6, 7]),
            (false, [0x43, 0x05, 0x60, 1, 1, 2, 3, 4]),
            (true, [0x40, 0x05, 0x60, 1, 0, 0, 0, 0]),
        ];
        assert_eq!(shown(&frames), frames.map(|(_, data)| data));
        // An abort ends it.
        let aborted = [
            (true, [0x21, 0x05, 0x60, 1, 10, 0, 0, 0]),
            (false, [0x80, 0x05, 0x60, 1, 0, 0, 1, 6]),
            (true, [0x00, 1, 2, 3, 4, 5, 6, 7]),
        ];
        assert_eq!(shown(&aborted), aborted.map(|(_, data)| data));
    }
}
