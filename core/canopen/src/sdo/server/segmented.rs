//! Expedited and segmented transfers.

use crate::abort::AbortCode;
use crate::od::{self, Access, Address, DataType, Entry, Kind, Objects, Reply};
use crate::sdo::fields::{self, scs};

use super::{Incoming, Outgoing, SdoServer, State, VALUE_MAX};

impl SdoServer {
    pub(super) fn initiate_download(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let at = fields::address(bytes);
        let data_type = self.writable(at, objects)?.data_type;
        let command = bytes[0];
        let is_size_indicated = command & fields::SIZE_INDICATED != 0;
        let expedited = command & fields::EXPEDITED != 0;
        let size = match (expedited, is_size_indicated) {
            (true, true) => Some(4 - u32::from(fields::unused_of_4(command))),
            // The frame does not give the number of data bytes among the four; the type does.
            (true, false) => Some(data_type.size().unwrap_or(4).min(4)),
            (false, true) => Some(fields::number(bytes)),
            (false, false) => None,
        };
        let incoming = Incoming::start(at, data_type, size, objects)?;
        self.state = State::Download { incoming, toggle: false };
        self.answer_initiate(scs::INITIATE_DOWNLOAD, 0);
        if let (true, Some(size)) = (expedited, size) {
            self.take(&fields::data(bytes)[..size as usize], objects)?;
            self.finish_download(true, objects)?;
        }
        Ok(())
    }

    pub(super) fn download_segment(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let command = bytes[0];
        let State::Download { toggle, .. } = &mut self.state else {
            return Err(self.config.unknown_request);
        };
        alternate(toggle, command)?;
        self.take(&bytes[1..8 - usize::from(fields::unused_of_7(command))], objects)?;
        if command & fields::LAST != 0 {
            self.finish_download(false, objects)?;
        }
        self.answer_transfer(scs::DOWNLOAD_SEGMENT | command & fields::TOGGLE, 0, 0);
        Ok(())
    }

    pub(super) fn initiate_upload(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let outgoing = self.readable(fields::address(bytes), objects)?;
        self.answer_upload(outgoing);
        Ok(())
    }

    /// The answer to an initiate of an upload: a whole variable of up to four bytes, or the number
    /// of bytes that follow in segments.
    pub(super) fn answer_upload(&mut self, outgoing: Outgoing) {
        let mut data = [0; 4];
        let command = match outgoing.size() {
            Some(size @ 1..=4) if !outgoing.is_domain() => {
                data[..size as usize].copy_from_slice(&self.value[..size as usize]);
                scs::INITIATE_UPLOAD | (4 - size as u8) << 2 | fields::EXPEDITED | fields::SIZE_INDICATED
            }
            size => {
                self.state = State::Upload { outgoing, toggle: false };
                data = size.unwrap_or(0).to_le_bytes();
                scs::INITIATE_UPLOAD | if size.is_some() { fields::SIZE_INDICATED } else { 0 }
            }
        };
        self.answer_initiate(command, u32::from_le_bytes(data));
    }

    pub(super) fn upload_segment(
        &mut self,
        bytes: &[u8; 8],
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let State::Upload { outgoing, toggle } = &mut self.state else {
            return Err(self.config.unknown_request);
        };
        alternate(toggle, bytes[0])?;
        let mut answer = [0; 8];
        let (len, last) = outgoing.next(self.at, &self.value, &mut answer, objects)?;
        answer[0] = scs::UPLOAD_SEGMENT | bytes[0] & fields::TOGGLE | (7 - len as u8) << 1 | u8::from(last);
        self.answer = Some(answer);
        if last {
            self.state = State::Idle;
        }
        Ok(())
    }

    /// Begins a download of a writable object.
    pub(super) fn writable(
        &mut self,
        at: Address,
        objects: &mut impl Objects,
    ) -> Result<&'static Entry, AbortCode> {
        let entry = self.begin(at, objects)?;
        if entry.access.is_writable() {
            Ok(entry)
        } else {
            Err(AbortCode::READ_ONLY)
        }
    }

    /// Begins an upload of a readable object. A variable or string is read at once.
    pub(super) fn readable(
        &mut self,
        at: Address,
        objects: &mut impl Objects,
    ) -> Result<Outgoing, AbortCode> {
        let entry = self.begin(at, objects)?;
        if !entry.access.is_readable() {
            return Err(AbortCode::WRITE_ONLY);
        }
        if entry.data_type == DataType::Domain {
            return Ok(Outgoing::domain(objects.upload_start(at)?));
        }
        let len = match (entry.access, entry.kind) {
            (Access::Const, Kind::Array(highest) | Kind::Record(highest)) => {
                od::put(&mut self.value, &[highest])?
            }
            _ => objects.read(at, &mut self.value)?,
        };
        // A value with another length than its type is an error of the device.
        if len > VALUE_MAX || entry.data_type.size().is_some_and(|size| size as usize != len) {
            return Err(AbortCode::INTERNAL);
        }
        Ok(Outgoing::value(len as u32))
    }

    /// Passes data to the object, or collects the value until it is complete.
    pub(super) fn take(&mut self, data: &[u8], objects: &mut impl Objects) -> Result<(), AbortCode> {
        let incoming = self.state.incoming().ok_or(AbortCode::COMMAND)?;
        incoming.take(self.at, data, &mut self.value, objects)
    }

    /// All data have arrived: the object accepts or refuses them. The answer to an `expedited`
    /// download waits already: the object may withhold it.
    pub(super) fn finish_download(
        &mut self,
        expedited: bool,
        objects: &mut impl Objects,
    ) -> Result<(), AbortCode> {
        let incoming = *self.state.incoming().ok_or(AbortCode::COMMAND)?;
        incoming.check()?;
        // The object gets the end, so it must not get a cancellation after it.
        self.state = State::Idle;
        if incoming.finish(self.at, &self.value, expedited, objects)? == Reply::Withhold {
            self.answer = None;
        }
        Ok(())
    }
}

/// Checks the toggle bit of a segment against the one expected, and expects the other one next.
fn alternate(expected: &mut bool, command: u8) -> Result<(), AbortCode> {
    if *expected != (command & fields::TOGGLE != 0) {
        return Err(AbortCode::TOGGLE);
    }
    *expected = !*expected;
    Ok(())
}
