//! The memory contents in a firmware file, with gaps.

use std::borrow::Cow;

use super::area::{Area, FLASH};
use super::fault::{Cause, Place, ReadError};
use super::note::Note;
use super::range::AddressRange;

/// The bytes of one record or segment of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Piece {
    pub(crate) address: u32,
    /// Never empty.
    pub(crate) data: Vec<u8>,
    pub(crate) place: Place,
}

impl Piece {
    pub(crate) fn range(&self) -> AddressRange {
        // `Pieces::add` drops empty pieces, and the readers refuse data that leave the address
        // space.
        AddressRange { first: self.address, last: self.address + (self.data.len() - 1) as u32 }
    }
}

/// Pieces in the order of the file, before they become an [`Image`].
#[derive(Debug, Default)]
pub(crate) struct Pieces {
    pieces: Vec<Piece>,
    notes: Vec<Note>,
}

impl Pieces {
    /// Adds the data at `place` of the file. The caller has checked that the data end inside the
    /// address space.
    pub(crate) fn add(&mut self, address: u32, data: Vec<u8>, place: Place) {
        if !data.is_empty() {
            self.pieces.push(Piece { address, data, place });
        }
    }

    /// Adds data that lie after all others: a piece of their own, unless no gap precedes them.
    pub(crate) fn extend(&mut self, address: u32, data: &[u8], place: Place) {
        match self.pieces.last_mut() {
            Some(last) if last.range().last.checked_add(1) == Some(address) => {
                last.data.extend_from_slice(data);
            }
            _ => self.add(address, data.to_vec(), place),
        }
    }

    /// Adds a warning.
    pub(crate) fn note(&mut self, note: Note) {
        self.notes.push(note);
    }

    /// Sorts the pieces by address. Pieces with the same bytes for the same addresses become one,
    /// with a warning.
    pub(crate) fn into_image(self) -> Result<Image, ReadError> {
        let Self { mut pieces, mut notes } = self;
        if pieces.is_empty() {
            return Err(Place::File.fault(Cause::NoData));
        }
        // The sort is stable: of two pieces at one address, the one that comes earlier in the file
        // stays first.
        pieces.sort_by_key(|piece| piece.address);
        let mut distinct: Vec<Piece> = Vec::with_capacity(pieces.len());
        let (mut first, mut count) = (None, 0);
        for high in pieces {
            let Some(low) = distinct.last_mut().filter(|low| low.range().last >= high.address) else {
                distinct.push(high);
                continue;
            };
            let (with, place) = (low.place.min(high.place), low.place.max(high.place));
            // `low` begins at or before `high` and reaches into it.
            let known = &low.data[(high.address - low.address) as usize..];
            let (common, rest) = high.data.split_at(known.len().min(high.data.len()));
            if !known.starts_with(common) {
                return Err(place.fault(Cause::Overlap { address: high.address, with }));
            }
            first = first.or(Some((high.address, place, with)));
            count += 1;
            low.data.extend_from_slice(rest);
        }
        notes.extend(first.map(|(address, place, with)| Note::Twice { address, place, with, count }));
        Ok(Image { pieces: distinct, notes })
    }

    /// An image from pieces that are already in address order and do not overlap.
    pub(crate) fn in_order(self) -> Image {
        Image { pieces: self.pieces, notes: self.notes }
    }
}

/// The text before the software version in a program (CiA 814-1, section 6.5), including its final
/// zero.
const VERSION_MARK: &[u8] = b"$CANopenSoftwareVersion\0";
/// The longest software version that is read.
const VERSION_MAX: usize = 255;

/// The memory contents in a firmware file: at least one byte, and at most one byte for each
/// address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// In address order, without overlap.
    pieces: Vec<Piece>,
    /// What is odd about the file.
    notes: Vec<Note>,
}

impl Image {
    /// The range from the first byte to the last, including gaps.
    #[must_use]
    pub fn span(&self) -> AddressRange {
        // An image has at least one piece, so the fallback is never used.
        let first = self.pieces.first().map_or(0, |piece| piece.address);
        let last = self.pieces.last().map_or(0, |piece| piece.range().last);
        AddressRange { first, last }
    }

    /// The number of bytes without gaps.
    #[must_use]
    pub fn byte_count(&self) -> u64 {
        self.pieces.iter().map(|piece| piece.data.len() as u64).sum()
    }

    /// The contiguous ranges of bytes, in address order.
    pub fn segments(&self) -> impl Iterator<Item = (u32, Cow<'_, [u8]>)> + '_ {
        let mut pieces = self.pieces.iter().peekable();
        std::iter::from_fn(move || {
            let piece = pieces.next()?;
            let mut data = Cow::Borrowed(&piece.data[..]);
            let mut last = piece.range().last;
            while let Some(next) = pieces.next_if(|next| Some(next.address) == last.checked_add(1)) {
                data.to_mut().extend_from_slice(&next.data);
                last = next.range().last;
            }
            Some((piece.address, data))
        })
    }

    /// Its pieces, addresses and bytes, in address order.
    pub(crate) fn runs(&self) -> impl Iterator<Item = (u32, &[u8])> {
        self.pieces.iter().map(|piece| (piece.address, &piece.data[..]))
    }

    /// Its bytes from the first to the last one; the gaps are erased flash.
    #[must_use]
    pub fn filled(&self) -> Cow<'_, [u8]> {
        self.flat(self.span().first, self.span().len() as u32)
    }

    /// The memory from `start` on, `size` bytes of it; the gaps are erased flash.
    pub(crate) fn flat(&self, start: u32, size: u32) -> Cow<'_, [u8]> {
        match &self.pieces[..] {
            [piece] if piece.address == start && piece.data.len() == size as usize => {
                return Cow::Borrowed(&piece.data);
            }
            _ => {}
        }
        let mut flash = vec![0xFF; size as usize];
        for (address, data) in self.runs() {
            let at = address.wrapping_sub(start) as usize;
            if let Some(place) = at.checked_add(data.len()).and_then(|end| flash.get_mut(at..end)) {
                place.copy_from_slice(data);
            }
        }
        Cow::Owned(flash)
    }

    /// The image moved up by `offset`, or `None` if it would exceed the address space. An offset of
    /// 2³² − n moves it down by n.
    #[must_use]
    pub fn moved(&self, offset: u32) -> Option<Self> {
        let mut moved = self.clone();
        for piece in &mut moved.pieces {
            piece.address = piece.address.wrapping_add(offset);
            piece.address.checked_add((piece.data.len() - 1) as u32)?;
        }
        // If some pieces wrapped around and others did not, the order is lost.
        let in_order = moved.pieces.windows(2).all(|pair| pair[0].address < pair[1].address);
        in_order.then_some(moved)
    }

    /// The software version after `$CANopenSoftwareVersion` in the program (CiA 814-1, section
    /// 6.5): the text of object 100Ah, encoded as ISO 8859-1. Control characters are replaced.
    #[must_use]
    pub fn software_version(&self) -> Option<String> {
        self.segments().find_map(|(_, data)| {
            let at = data.windows(VERSION_MARK.len()).position(|window| window == VERSION_MARK)?;
            let text =
                data[at + VERSION_MARK.len()..].iter().take(VERSION_MAX).take_while(|byte| **byte != 0);
            let visible = |byte: &u8| match char::from(*byte) {
                letter if letter.is_control() => '?',
                letter => letter,
            };
            Some(text.map(visible).collect())
        })
    }

    /// The bytes from an address on, or `None` if the file does not have all of them.
    #[must_use]
    pub fn bytes<const N: usize>(&self, address: u32) -> Option<[u8; N]> {
        let mut bytes = [0; N];
        let mut present = 0;
        let end = u64::from(address) + N as u64;
        for piece in &self.pieces {
            let from = u64::from(piece.address);
            let (first, after) = (from.max(address.into()), (from + piece.data.len() as u64).min(end));
            if first < after {
                let data = &piece.data[(first - from) as usize..(after - from) as usize];
                let at = (first - u64::from(address)) as usize;
                bytes[at..at + data.len()].copy_from_slice(data);
                present += data.len();
            }
        }
        (present == N).then_some(bytes)
    }

    /// The value of all bytes, if they are all equal.
    pub(crate) fn only_byte(&self) -> Option<u8> {
        let first = self.pieces.first()?.data[0];
        let all = self.pieces.iter().flat_map(|piece| &piece.data);
        all.into_iter().all(|byte| *byte == first).then_some(first)
    }

    /// Its pieces, and what is odd about the file.
    pub(crate) fn into_pieces(self) -> (Vec<Piece>, Vec<Note>) {
        (self.pieces, self.notes)
    }

    /// What is odd about the file: its reader warns of it.
    #[must_use]
    pub fn notes(&self) -> &[Note] {
        &self.notes
    }

    /// The first data in an area that is not the main flash, if the image also has data in the
    /// flash.
    pub(crate) fn strays(&self) -> Option<(&Piece, Area)> {
        self.pieces.iter().find(|piece| FLASH.has(piece.address))?;
        self.pieces.iter().find_map(|piece| Some((piece, Area::of(piece.address)?)))
    }

    /// Checks that all data lie in the main flash, if some of them do.
    ///
    /// # Errors
    /// [`Cause::Elsewhere`] with the place in the file.
    pub fn check_areas(&self) -> Result<(), ReadError> {
        match self.strays() {
            None => Ok(()),
            Some((piece, area)) => Err(piece.place.fault(Cause::Elsewhere { range: piece.range(), area })),
        }
    }

    /// Checks that no data lie outside `range`.
    ///
    /// # Errors
    /// [`Cause::Outside`] or [`Cause::Elsewhere`] with the place in the file.
    pub fn check_inside(&self, range: AddressRange) -> Result<(), ReadError> {
        match self.pieces.iter().find(|piece| !range.contains(&piece.range())) {
            None => Ok(()),
            Some(piece) => Err(piece.place.fault(Cause::outside(piece.range(), range))),
        }
    }

    /// The part inside `range`, or `None` if nothing lies inside.
    #[must_use]
    pub fn part(&self, range: AddressRange) -> Option<Self> {
        let pieces: Vec<Piece> = self
            .pieces
            .iter()
            .filter_map(|piece| {
                let own = piece.range();
                let (first, last) = (own.first.max(range.first), own.last.min(range.last));
                (first <= last).then(|| {
                    let data = &piece.data[(first - own.first) as usize..=(last - own.first) as usize];
                    Piece { address: first, data: data.to_vec(), place: piece.place }
                })
            })
            .collect();
        (!pieces.is_empty()).then(|| Self { pieces, notes: self.notes.clone() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(pieces: &[(u32, &[u8])]) -> Image {
        let mut all = Pieces::default();
        for (line, (address, data)) in pieces.iter().enumerate() {
            all.add(*address, data.to_vec(), Place::Line(line + 1));
        }
        all.into_image().unwrap()
    }

    #[test]
    fn neighbours_become_one_segment_whatever_their_order() {
        let image = image(&[(8, &[3]), (4, &[1, 2]), (6, &[9, 9]), (u32::MAX, &[7])]);
        assert!(image.segments().eq([(4, vec![1, 2, 9, 9, 3].into()), (u32::MAX, vec![7].into())]));
        assert_eq!(image.span(), AddressRange { first: 4, last: u32::MAX });
    }

    #[test]
    fn an_inner_overlap_names_the_later_line() {
        let mut all = Pieces::default();
        all.add(0x10, vec![1], Place::Line(1));
        all.add(0x20, vec![0; 4], Place::Line(2));
        all.add(0x0F, vec![0; 2], Place::Line(3));
        let error = all.into_image().unwrap_err().to_string();
        assert_eq!(error, "line 3: the data at 0x00000010 overlaps that of line 1");
    }

    /// A linker with two program headers for one place, a HEX file with a record twice: the bytes
    /// are the same, so the program is.
    #[test]
    fn the_same_bytes_twice_are_taken_with_a_warning() {
        let with = |pieces: &[(u32, &[u8])]| {
            let mut all = Pieces::default();
            for (line, (address, data)) in pieces.iter().enumerate() {
                all.add(*address, data.to_vec(), Place::Line(line + 1));
            }
            all.into_image()
        };
        // The same record, a part of it, one that reaches further, and one that begins inside both.
        let image = with(&[
            (4, &[1, 2, 3, 4]),
            (4, &[1, 2, 3, 4]),
            (5, &[2]),
            (6, &[3, 4, 5, 6]),
            (7, &[4, 5]),
            (12, &[9]),
        ])
        .unwrap();
        assert!(image.segments().eq([(4, vec![1, 2, 3, 4, 5, 6].into()), (12, vec![9].into())]));
        let words: Vec<String> = image.notes().iter().map(ToString::to_string).collect();
        assert_eq!(
            words,
            ["line 2: the data at 0x00000004 are those of line 1 once more, the first of 4 repetitions"]
        );
        assert!(with(&[(4, &[1, 2]), (6, &[1, 2])]).unwrap().notes().is_empty());
        for other in [&[9, 2, 3, 4][..], &[1, 2, 3, 9], &[1, 9], &[1, 2, 3, 4, 5, 9]] {
            let pieces = [(4, &[1, 2, 3, 4][..]), (8, &[5, 6]), (4, other)];
            assert!(with(&pieces).unwrap_err().to_string().contains("overlaps"), "{other:?}");
        }
    }

    #[test]
    fn bytes_are_told_when_all_of_them_are_there() {
        let image = image(&[(4, &[1, 2]), (6, &[3]), (8, &[5]), (u32::MAX, &[9])]);
        assert_eq!(image.bytes(4), Some([1, 2, 3]));
        assert_eq!(image.bytes(5), Some([2, 3]));
        assert_eq!(image.bytes::<4>(5), None, "7 is a hole");
        assert_eq!(image.bytes::<2>(3), None);
        assert_eq!(image.bytes(u32::MAX), Some([9]));
        assert_eq!(image.bytes::<2>(u32::MAX), None);
    }

    #[test]
    fn a_part_is_cut_at_both_ends() {
        let image = image(&[(4, &[1, 2, 3, 4]), (12, &[5])]);
        let range = AddressRange { first: 5, last: 6 };
        assert!(image.part(range).unwrap().segments().eq([(5, vec![2, 3].into())]));
        assert_eq!(image.part(AddressRange { first: 8, last: 11 }), None);
        assert!(image.check_inside(AddressRange { first: 4, last: 12 }).is_ok());
        let error = image.check_inside(AddressRange { first: 4, last: 11 }).unwrap_err().to_string();
        assert!(error.starts_with("line 2: the data at 0x0000000c..=0x0000000c lies outside"), "{error}");
    }
}
