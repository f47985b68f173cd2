//! The object dictionary: its entries as a table, its values behind the trait [`Objects`].
//!
//! ```
//! use canopen::od::{Access, Address, DataType, Entry, Objects};
//! use canopen::AbortCode;
//!
//! const ENTRIES: &[Entry] = &[
//!     Entry::var(0x1000, "Device type", DataType::Unsigned32, Access::Const).default(0x1000_0000),
//!     Entry::record(0x1018, "Identity object", 1),
//!     Entry::sub(0x1018, 1, "Vendor-ID", DataType::Unsigned32, Access::Const),
//! ];
//!
//! struct Device;
//!
//! impl Objects for Device {
//!     fn entries(&self) -> &'static [Entry] {
//!         ENTRIES
//!     }
//!
//!     fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
//!         match (at.index, at.sub) {
//!             (0x1000, 0) => canopen::od::put(buf, &0x1000_0000_u32.to_le_bytes()),
//!             (0x1018, 1) => canopen::od::put(buf, &0x0000_0123_u32.to_le_bytes()),
//!             _ => Err(AbortCode::NO_DATA),
//!         }
//!     }
//! }
//! ```
//!
//! The SDO server checks every access against the table before it calls the device, so an
//! implementation gets only permitted accesses:
//!
//! | the client | abort |
//! |---|---|
//! | names an index that is not in the table | 06020000h |
//! | names a sub-index that is not in the table | 06090011h |
//! | writes `const` or `ro` | 06010002h |
//! | reads `wo` | 06010001h |
//! | writes more, or fewer, bytes than the type has | 06070012h, 06070013h |
//! | sends another number of bytes than it announced | 06070010h |

use core::fmt;

use crate::abort::AbortCode;
use crate::frame::{Channel, CobId, Frame};
use crate::nmt::NmtState;
use crate::time::Instant;

/// Index and sub-index of a value: the multiplexer of an SDO.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Address {
    /// Index of the object.
    pub index: u16,
    /// Sub-index of the value; 0 for an object of one value.
    pub sub: u8,
}

impl Address {
    /// The value with this index and sub-index.
    #[must_use]
    pub const fn new(index: u16, sub: u8) -> Self {
        Self { index, sub }
    }
}

/// `1F50h/1`.
impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:04X}h/{}", self.index, self.sub)
    }
}

/// Data types of CiA 301 table 44, with their codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum DataType {
    /// One byte, 0 or 1.
    Boolean = 0x01,
    /// Signed, 1 byte.
    Integer8 = 0x02,
    /// Signed, 2 bytes.
    Integer16 = 0x03,
    /// Signed, 4 bytes.
    Integer32 = 0x04,
    /// Unsigned, 1 byte.
    Unsigned8 = 0x05,
    /// Unsigned, 2 bytes.
    Unsigned16 = 0x06,
    /// Unsigned, 4 bytes.
    Unsigned32 = 0x07,
    /// Text, of any length up to [`VALUE_MAX`](crate::sdo::server::VALUE_MAX).
    VisibleString = 0x09,
    /// Bytes, of any length up to [`VALUE_MAX`](crate::sdo::server::VALUE_MAX).
    OctetString = 0x0A,
    /// Data of any length, never held as a whole.
    Domain = 0x0F,
    /// Unsigned, 8 bytes.
    Unsigned64 = 0x1B,
}

impl DataType {
    /// The size of a value in bytes; `None` for types of variable length.
    #[must_use]
    pub const fn size(self) -> Option<u32> {
        // Bytes first: the compiler's table of them has 28 bytes, and one of `Option<u32>` has 224.
        let bytes: u8 = match self {
            Self::Boolean | Self::Integer8 | Self::Unsigned8 => 1,
            Self::Integer16 | Self::Unsigned16 => 2,
            Self::Integer32 | Self::Unsigned32 => 4,
            Self::Unsigned64 => 8,
            Self::VisibleString | Self::OctetString | Self::Domain => return None,
        };
        Some(bytes as u32)
    }
}

/// Access of a client to a value (CiA 301 table 43).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Read; the value never changes.
    Const,
    /// Read.
    Ro,
    /// Write.
    Wo,
    /// Both.
    Rw,
}

impl Access {
    /// Whether an upload is allowed.
    #[must_use]
    pub const fn is_readable(self) -> bool {
        !matches!(self, Self::Wo)
    }

    /// Whether a download is allowed.
    #[must_use]
    pub const fn is_writable(self) -> bool {
        matches!(self, Self::Wo | Self::Rw)
    }
}

/// The role of an entry in its object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// An object of one value (VAR, or DOMAIN by its type).
    Var,
    /// Sub-index 0 of an object with values of one type; its value is the highest sub-index.
    Array(u8),
    /// Sub-index 0 of an object with values of different types; its value is the highest sub-index.
    Record(u8),
    /// A value of an array or record.
    Sub,
}

/// The value before the first write.
#[cfg(feature = "names")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DefaultValue {
    /// Not given.
    None,
    /// A number.
    Number(u64),
    /// A text.
    Text(&'static str),
}

/// One value of the object dictionary.
#[derive(Clone, Copy, Debug)]
pub struct Entry {
    /// Index and sub-index.
    pub at: Address,
    /// Type of the value.
    pub data_type: DataType,
    /// Access of a client to it.
    pub access: Access,
    /// Its role in the object.
    pub kind: Kind,
    /// Name, of the whole object for [`Kind::Array`] and [`Kind::Record`].
    #[cfg(feature = "names")]
    pub name: &'static str,
    /// The value before the first write.
    #[cfg(feature = "names")]
    pub default: DefaultValue,
}

impl Entry {
    const fn new(at: Address, name: &'static str, data_type: DataType, access: Access, kind: Kind) -> Self {
        #[cfg(not(feature = "names"))]
        let _ = name;
        Self {
            at,
            data_type,
            access,
            kind,
            #[cfg(feature = "names")]
            name,
            #[cfg(feature = "names")]
            default: DefaultValue::None,
        }
    }

    /// An object of one value.
    #[must_use]
    pub const fn var(index: u16, name: &'static str, data_type: DataType, access: Access) -> Self {
        Self::new(Address::new(index, 0), name, data_type, access, Kind::Var)
    }

    /// Sub-index 0 of an object with values of one type. The server answers it from the table.
    #[must_use]
    pub const fn array(index: u16, name: &'static str, highest: u8) -> Self {
        Self::new(Address::new(index, 0), name, DataType::Unsigned8, Access::Const, Kind::Array(highest))
    }

    /// Sub-index 0 of an object with values of different types. The server answers it from the
    /// table.
    #[must_use]
    pub const fn record(index: u16, name: &'static str, highest: u8) -> Self {
        Self::new(Address::new(index, 0), name, DataType::Unsigned8, Access::Const, Kind::Record(highest))
    }

    /// A value of an array or record; in the table it follows sub-index 0.
    #[must_use]
    pub const fn sub(index: u16, sub: u8, name: &'static str, data_type: DataType, access: Access) -> Self {
        Self::new(Address::new(index, sub), name, data_type, access, Kind::Sub)
    }

    /// Sets another access. A sub-index 0 that is not `const`, such as 1003h/0, is read from and
    /// written to the implementation of [`Objects`].
    #[must_use]
    pub const fn access(mut self, access: Access) -> Self {
        self.access = access;
        self
    }

    /// Sets a number as default value.
    #[must_use]
    #[cfg_attr(not(feature = "names"), allow(unused_mut))]
    pub const fn default(mut self, value: u64) -> Self {
        #[cfg(not(feature = "names"))]
        let _ = value;
        #[cfg(feature = "names")]
        {
            self.default = DefaultValue::Number(value);
        }
        self
    }

    /// Takes the default value away.
    #[must_use]
    #[cfg_attr(not(feature = "names"), allow(unused_mut))]
    pub const fn without_default(mut self) -> Self {
        #[cfg(feature = "names")]
        {
            self.default = DefaultValue::None;
        }
        self
    }

    /// Sets a text as default value.
    #[must_use]
    #[cfg_attr(not(feature = "names"), allow(unused_mut))]
    pub const fn default_text(mut self, value: &'static str) -> Self {
        #[cfg(not(feature = "names"))]
        let _ = value;
        #[cfg(feature = "names")]
        {
            self.default = DefaultValue::Text(value);
        }
        self
    }
}

/// Finds the entry of a value.
///
/// # Errors
/// [`AbortCode::NO_OBJECT`] if no entry has the index, [`AbortCode::NO_SUB_INDEX`] if none of these
/// entries has the sub-index.
pub fn find(entries: &[Entry], at: Address) -> Result<&Entry, AbortCode> {
    let mut code = AbortCode::NO_OBJECT;
    for entry in entries {
        if entry.at == at {
            return Ok(entry);
        }
        if entry.at.index == at.index {
            code = AbortCode::NO_SUB_INDEX;
        }
    }
    Err(code)
}

/// A table of `LEN` entries, assembled in a constant from the parts of a device. In a constant, a
/// panic of these functions is a compile error.
#[derive(Clone, Copy, Debug)]
pub struct Table<const LEN: usize> {
    entries: [Entry; LEN],
    len: usize,
}

impl<const LEN: usize> Table<LEN> {
    /// A table without entries yet.
    pub const EMPTY: Self = Self { entries: [Entry::array(0, "", 0); LEN], len: 0 };

    /// Appends a part.
    ///
    /// # Panics
    /// If the table has too few entries left.
    #[must_use]
    pub const fn with(mut self, part: &[Entry]) -> Self {
        assert!(part.len() <= LEN - self.len, "od::Table: LEN is less than the parts have");
        let mut i = 0;
        while i < part.len() {
            self.entries[self.len] = part[i];
            self.len += 1;
            i += 1;
        }
        self
    }

    /// The entries so far: for a tool that makes tables of several devices.
    #[must_use]
    pub fn parts(&self) -> &[Entry] {
        &self.entries[..self.len]
    }

    /// The complete table.
    ///
    /// # Panics
    /// If the parts have fewer than `LEN` entries.
    #[must_use]
    pub const fn entries(self) -> [Entry; LEN] {
        assert!(self.len == LEN, "od::Table: LEN is more than the parts have");
        self.entries
    }
}

/// Copies a value to the start of `buf` and returns its length, as [`Objects::read`] must.
///
/// # Errors
/// [`AbortCode::OUT_OF_MEMORY`] if it does not fit.
pub fn put(buf: &mut [u8], value: &[u8]) -> Result<usize, AbortCode> {
    buf.get_mut(..value.len()).ok_or(AbortCode::OUT_OF_MEMORY)?.copy_from_slice(value);
    Ok(value.len())
}

/// What the SDO server does after an object has taken a download.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reply {
    /// It confirms the download.
    Send,
    /// It sends nothing: another program of the device confirms in its place, as a bootloader does
    /// after a reset.
    Withhold,
}

/// What a device exchanges beside SDO, emergencies and NMT: PDOs and SYNC
/// ([`Pdos`](crate::pdo::Pdos) has them), and frames of its own.
pub trait Exchange {
    /// A command of the NMT master: the node has this state now.
    fn state_changed(&mut self, state: NmtState);

    /// Processes any received frame that is no NMT command, after the boot-up.
    fn handle(&mut self, frame: &Frame);

    /// The next frame to send, `None` if there is none. It is asked in OPERATIONAL alone, when no
    /// answer and no emergency waits.
    fn poll(&mut self, now: Instant) -> Option<Frame>;

    /// The identifiers to accept in addition to those of the slave, counted from 0; `None` after
    /// the last.
    fn identifier(&self, place: usize) -> Option<CobId>;

    /// Whether they were changed since the last call.
    fn identifiers_changed(&mut self) -> bool;
}

/// The values of the table.
///
/// Variables and strings are read and written as a whole. **Domains** are streamed, and the server
/// never holds them as a whole. An error becomes the SDO abort for the client.
///
/// A domain download is `download_start`, `download_data` any number of times, and then exactly one
/// of `download_end` and `download_cancel`. The server calls `download_cancel` if the client aborts
/// or starts another transfer, after a time-out, after an error of `download_data`, or if the sizes
/// do not match. After an error of `download_start` it calls neither.
pub trait Objects {
    /// Whether the device may have a second SDO server (1201h). Without it, the compiler leaves out
    /// the code for it.
    #[must_use]
    fn has_second_server() -> bool
    where
        Self: Sized,
    {
        false
    }

    /// Whether objects can be written by block download. Without it, the compiler leaves out the code for
    /// it, and its requests are unknown requests.
    #[must_use]
    fn has_block_download() -> bool
    where
        Self: Sized,
    {
        true
    }

    /// Whether objects can be read by block upload. Without it, the compiler leaves out the code for it,
    /// and its requests are unknown requests.
    #[must_use]
    fn has_block_upload() -> bool
    where
        Self: Sized,
    {
        true
    }

    /// The table.
    fn entries(&self) -> &'static [Entry];

    /// Reads a variable (little-endian) or string into `buf` and returns its length.
    ///
    /// # Errors
    /// Sent to the client as abort.
    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode>;

    /// Writes a variable (little-endian) or string. A variable has the length of its type.
    ///
    /// # Errors
    /// Sent to the client as abort.
    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        let _ = (at, data);
        Err(AbortCode::UNSUPPORTED_ACCESS)
    }

    /// Writes as [`write`](Self::write), and says who confirms: the server calls this one.
    ///
    /// `expedited`: the confirmation names the object and nothing else (CiA 301 clause 7.2.4.3.3), so
    /// that another program can send it. That of segments and blocks belongs to the transfer: the
    /// server sends it whatever this returns, and a device does what goes with that.
    ///
    /// # Errors
    /// Sent to the client as abort.
    fn write_with_reply(&mut self, at: Address, data: &[u8], expedited: bool) -> Result<Reply, AbortCode> {
        let _ = expedited;
        self.write(at, data).map(|()| Reply::Send)
    }

    /// Starts a download of a domain, of `size` bytes if the client announced it.
    ///
    /// # Errors
    /// Sent to the client as abort.
    fn download_start(&mut self, at: Address, size: Option<u32>) -> Result<(), AbortCode> {
        let _ = (at, size);
        Err(AbortCode::UNSUPPORTED_ACCESS)
    }

    /// The number of bytes that [`download_data`](Self::download_data) can accept at present.
    /// Without room for a segment (7 bytes) the server delays its answer, and so the client. After
    /// [`HOLD_MS`](crate::sdo::server::HOLD_MS) it calls again with `held`: the implementation
    /// should then give room from a reserve, so that the client is slowed down but still gets
    /// answers.
    fn download_space(&mut self, at: Address, held: bool) -> usize {
        let _ = (at, held);
        usize::MAX
    }

    /// The next bytes of the domain.
    ///
    /// # Errors
    /// Sent to the client as abort.
    fn download_data(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        let _ = (at, data);
        Err(AbortCode::UNSUPPORTED_ACCESS)
    }

    /// The domain is complete. An error replaces the last acknowledgement.
    ///
    /// # Errors
    /// Sent to the client as abort.
    fn download_end(&mut self, at: Address) -> Result<(), AbortCode> {
        let _ = at;
        Ok(())
    }

    /// The download ended before the domain was complete.
    fn download_cancel(&mut self, at: Address) {
        let _ = at;
    }

    /// The COB-IDs of the second SDO server.
    fn second_server(&self) -> Channel {
        Channel::NONE
    }

    /// The data of the next emergency to send, `None` if there is none ([`Emcy`](crate::emcy::Emcy)
    /// stores them).
    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        None
    }

    /// What the device exchanges beside SDO, emergencies and NMT, `None` if there is nothing.
    fn exchange(&mut self) -> Option<&mut dyn Exchange> {
        None
    }

    /// Starts an upload of a domain; returns its size in bytes if it is known.
    ///
    /// # Errors
    /// Sent to the client as abort.
    fn upload_start(&mut self, at: Address) -> Result<Option<u32>, AbortCode> {
        let _ = at;
        Err(AbortCode::UNSUPPORTED_ACCESS)
    }

    /// Reads the domain from `offset` on. Fills `buf` unless the domain ends before, and returns
    /// the number of bytes; 0 is the end. A block upload may read the same offset again.
    ///
    /// # Errors
    /// Sent to the client as abort.
    fn upload_data(&mut self, at: Address, offset: u32, buf: &mut [u8]) -> Result<usize, AbortCode> {
        let _ = (at, offset, buf);
        Err(AbortCode::UNSUPPORTED_ACCESS)
    }
}
