//! A device for the tests, and the wire between both ends.

use canopen::frame::Channel;
use canopen::od::{put, Access, DataType, Entry, Reply};
use canopen::sdo::server::{Config, SdoServer};
use canopen::{AbortCode, Address, CobId, Frame, Instant, NodeId, Objects};

pub const NODE: u8 = 5;

pub fn node() -> NodeId {
    NodeId::new(NODE).unwrap()
}

pub fn at(millis: u32) -> Instant {
    Instant::from_millis(millis)
}

/// A frame of the client to the server.
pub fn request(bytes: [u8; 8]) -> Frame {
    Frame::of(CobId::sdo_request(node()), &bytes)
}

/// A frame of the server to the client.
pub fn response(bytes: [u8; 8]) -> Frame {
    Frame::of(CobId::sdo_response(node()), &bytes)
}

const ENTRIES: &[Entry] = &[
    Entry::var(0x1000, "Device type", DataType::Unsigned32, Access::Const).default(0x1000_0000),
    Entry::var(0x1008, "Manufacturer device name", DataType::VisibleString, Access::Const),
    Entry::var(0x1017, "Producer heartbeat time", DataType::Unsigned16, Access::Rw),
    Entry::record(0x1018, "Identity object", 4),
    Entry::sub(0x1018, 1, "Vendor-ID", DataType::Unsigned32, Access::Const),
    Entry::array(0x1F50, "Program data", 1),
    Entry::sub(0x1F50, 1, "Program number 1", DataType::Domain, Access::Wo),
    Entry::array(0x1F51, "Program control", 1),
    Entry::sub(0x1F51, 1, "Program number 1", DataType::Unsigned8, Access::Rw),
    Entry::var(0x2000, "Domain", DataType::Domain, Access::Rw),
    Entry::var(0x2001, "Text", DataType::VisibleString, Access::Rw),
    Entry::var(0x2002, "Secret", DataType::Unsigned32, Access::Wo),
    Entry::var(0x2003, "Long", DataType::Unsigned64, Access::Rw),
];

/// The calls that the device has received for the domain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    Start(Option<u32>),
    End(Vec<u8>),
    Cancel,
}

/// A device with a second SDO server.
pub type Device = DeviceOf<true>;

/// A domain at 2000h and 1F50h/1, and writable values; with or without a second SDO server.
#[derive(Debug, Default)]
pub struct DeviceOf<const SECOND: bool> {
    pub heartbeat: u16,
    pub control: u8,
    pub text: Vec<u8>,
    pub long: u64,
    /// The last completed domain, which an upload reads.
    pub domain: Vec<u8>,
    /// Whether an upload announces the size.
    pub tells_size: bool,
    pub incoming: Option<Vec<u8>>,
    /// All data of downloads to a domain, completed or not.
    pub taken: Vec<u8>,
    pub events: Vec<Event>,
    /// Room left for domain data; `None` for unlimited.
    pub space: Option<usize>,
    /// The part of it that is a reserve for delayed clients.
    pub reserve: usize,
    /// Whether it refuses the end of a domain download.
    pub refuse_end: Option<AbortCode>,
    /// Whether it leaves the confirmations of expedited downloads to another program.
    pub withholds: bool,
    /// The second SDO server, if it has one.
    pub second: Option<Channel>,
}

impl<const SECOND: bool> Objects for DeviceOf<SECOND> {
    fn has_second_server() -> bool {
        SECOND
    }

    fn entries(&self) -> &'static [Entry] {
        ENTRIES
    }

    fn second_server(&self) -> Channel {
        self.second.unwrap_or(Channel::NONE)
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        match (at.index, at.sub) {
            (0x1000, 0) => put(buf, &0x1000_0000_u32.to_le_bytes()),
            (0x1008, 0) => put(buf, b"coboot bootloader"),
            (0x1017, 0) => put(buf, &self.heartbeat.to_le_bytes()),
            (0x1018, 1) => put(buf, &0x0102_0304_u32.to_le_bytes()),
            (0x1F51, 1) => put(buf, &[self.control]),
            (0x2001, 0) => put(buf, &self.text),
            (0x2003, 0) => put(buf, &self.long.to_le_bytes()),
            _ => panic!("the table does not allow a read of {at}"),
        }
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        match (at.index, at.sub) {
            (0x1017, 0) => self.heartbeat = u16::from_le_bytes(data.try_into().unwrap()),
            (0x1F51, 1) => {
                if data[0] == 0x7F {
                    return Err(AbortCode::INVALID_VALUE);
                }
                self.control = data[0];
            }
            (0x2001, 0) => self.text = data.to_vec(),
            (0x2002, 0) => assert_eq!(data.len(), 4),
            (0x2003, 0) => self.long = u64::from_le_bytes(data.try_into().unwrap()),
            _ => panic!("the table does not allow a write of {at}"),
        }
        Ok(())
    }

    fn write_with_reply(&mut self, at: Address, data: &[u8], expedited: bool) -> Result<Reply, AbortCode> {
        self.write(at, data)?;
        Ok(if self.withholds && expedited { Reply::Withhold } else { Reply::Send })
    }

    fn download_start(&mut self, _at: Address, size: Option<u32>) -> Result<(), AbortCode> {
        assert!(self.incoming.is_none(), "the last download neither ended nor was cancelled");
        self.incoming = Some(Vec::new());
        self.events.push(Event::Start(size));
        Ok(())
    }

    fn download_space(&mut self, _at: Address, held: bool) -> usize {
        self.space.unwrap_or(usize::MAX).saturating_sub(if held { 0 } else { self.reserve })
    }

    fn download_data(&mut self, _at: Address, data: &[u8]) -> Result<(), AbortCode> {
        assert!(!data.is_empty(), "data without data");
        if let Some(space) = &mut self.space {
            *space = space.checked_sub(data.len()).expect("data in spite of no space");
        }
        self.taken.extend(data);
        self.incoming.as_mut().expect("data outside a download").extend(data);
        Ok(())
    }

    fn download_end(&mut self, _at: Address) -> Result<(), AbortCode> {
        let data = self.incoming.take().expect("end outside a download");
        if let Some(code) = self.refuse_end {
            return Err(code);
        }
        self.domain.clone_from(&data);
        self.events.push(Event::End(data));
        Ok(())
    }

    fn download_cancel(&mut self, _at: Address) {
        self.incoming.take().expect("cancel outside a download");
        self.events.push(Event::Cancel);
    }

    fn upload_start(&mut self, _at: Address) -> Result<Option<u32>, AbortCode> {
        Ok(self.tells_size.then_some(self.domain.len() as u32))
    }

    fn upload_data(&mut self, _at: Address, offset: u32, buf: &mut [u8]) -> Result<usize, AbortCode> {
        let remaining = &self.domain[offset as usize..];
        let len = remaining.len().min(buf.len());
        buf[..len].copy_from_slice(&remaining[..len]);
        Ok(len)
    }
}

/// A server alone.
pub struct Bench {
    pub server: SdoServer,
    pub device: Device,
    /// In ms.
    pub now: u32,
}

impl Bench {
    pub fn with(config: Config) -> Self {
        Self { server: SdoServer::new(node(), config), device: Device::default(), now: 0 }
    }

    pub fn send(&mut self, frame: &Frame) {
        self.server.handle(frame, at(self.now), &mut self.device);
    }

    pub fn poll(&mut self) -> Option<Frame> {
        self.server.poll(at(self.now), &mut self.device)
    }

    /// All frames that the server sends now.
    pub fn sent(&mut self) -> Vec<Frame> {
        core::iter::from_fn(|| self.poll()).collect()
    }

    /// All frames that it sends after this frame.
    pub fn ask(&mut self, bytes: [u8; 8]) -> Vec<Frame> {
        self.send(&request(bytes));
        self.sent()
    }
}
