//! A test between a tool and its adapter.

use std::time::Duration;

use canopen::{CobId, Frame};
use coboot_can::{Adapter, AdapterError};
use embedded_can::Frame as _;
use kit::fake::NODE;

type Received = Result<Option<Frame>, AdapterError>;
type OnSend<'t, A> = dyn FnMut(&mut A, &Frame) + 't;
type Receive<'t, A> = dyn FnMut(&mut A, Duration) -> Received + 't;

/// An adapter whose frames a test sees before they are sent, or receives in the place of the tool.
pub struct Tap<'t, A> {
    pub of: A,
    on_send: Box<OnSend<'t, A>>,
    receive: Box<Receive<'t, A>>,
}

impl<'t, A: Adapter + 't> Tap<'t, A> {
    pub fn sending(of: A, on_send: impl FnMut(&mut A, &Frame) + 't) -> Self {
        Self { of, on_send: Box::new(on_send), receive: Box::new(A::receive) }
    }

    pub fn receiving(of: A, receive: impl FnMut(&mut A, Duration) -> Received + 't) -> Self {
        Self { of, on_send: Box::new(|_, _| {}), receive: Box::new(receive) }
    }

    /// The SDO answers of the node have this many bytes.
    pub fn shortened(of: A, len: usize) -> Self {
        let answers = CobId::new(0x580 + u16::from(NODE));
        Self::receiving(of, move |of, timeout| {
            Ok(of.receive(timeout)?.map(|frame| match frame.cob_id() {
                id if id == answers => Frame::of(id.unwrap(), &frame.data()[..len]),
                _ => frame,
            }))
        })
    }
}

impl<A: Adapter> Adapter for Tap<'_, A> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        (self.on_send)(&mut self.of, frame);
        self.of.send(frame)
    }

    fn receive(&mut self, timeout: Duration) -> Received {
        (self.receive)(&mut self.of, timeout)
    }

    fn now(&self) -> Duration {
        self.of.now()
    }
}
