//! The parts of the UART's driver that work without a chip (`bsp::uart`, `bsp::ring`).

use bsp::ring::{Inbox, Ring, LOST};
use bsp::uart::divider;

/// RM0090 section 30.3.4 (42 MHz, 16 samples a bit): USARTDIV is 22.8125 for 115.2 kbit/s, 273.4375
/// for 9.6 kbit/s, and 2.875 for 921.6 kbit/s (an error of 0.93 %).
#[test]
fn dividers_of_the_manual() {
    assert_eq!(divider(42_000_000, 115_200), Some(365));
    assert_eq!(divider(42_000_000, 9_600), Some(4375));
    assert_eq!(divider(42_000_000, 921_600), Some(46));
    assert_eq!(divider(16_000_000, 1_000_000), Some(16));
    // 15 cycles a bit are too few, an error of 2.8 % is too large, 70 000 does not fit.
    for (clock, rate) in [(15_000_000, 1_000_000), (1_750_000, 100_000), (42_000_000, 600), (42_000_000, 0)] {
        assert_eq!(divider(clock, rate), None, "{clock} {rate}");
    }
}

#[test]
fn bytes_come_out_as_they_went_in_and_one_too_many_is_refused() {
    let ring: Ring<4> = Ring::new();
    for round in 0..10 {
        assert!(ring.is_empty() && ring.take().is_none());
        assert_eq!([1, 2, 3, 4].map(|byte| ring.put(byte + round)), [true, true, true, false]);
        assert_eq!((ring.len(), ring.room()), (3, 0));
        assert_eq!(ring.take(), Some(1 + round));
        assert!(ring.put(9) && !ring.put(9));
        assert_eq!([(); 4].map(|()| ring.take()), [Some(2 + round), Some(3 + round), Some(9), None]);
    }
}

fn all<const N: usize>(inbox: &Inbox<N>) -> Vec<u8> {
    std::iter::from_fn(|| inbox.take()).collect()
}

/// There is one mark at each place with lost bytes, as soon as there is room for it: bytes before
/// and after the loss are never adjacent.
#[test]
fn a_mark_stands_wherever_bytes_are_missing() {
    let inbox: Inbox<6> = Inbox::new();
    inbox.come(Some(b'a'), false);
    assert!(!inbox.take_overruns() && !inbox.is_pressing());
    // The first byte is unreadable; after the second one the controller lost bytes.
    inbox.come(None, false);
    inbox.come(Some(b'b'), true);
    assert!(inbox.take_overruns() && !inbox.take_overruns());
    inbox.come(Some(b'c'), false);
    assert!(inbox.is_pressing());
    assert_eq!(all(&inbox), [b'a', LOST, b'b', LOST, b'c']);

    // Five bytes fit. The others are lost until there is room for the mark and the next byte.
    for byte in b"1234567" {
        inbox.come(Some(*byte), false);
    }
    assert!(inbox.take_overruns());
    assert_eq!(inbox.take(), Some(b'1'));
    inbox.come(Some(b'8'), false);
    assert_eq!(inbox.take(), Some(b'2'));
    inbox.come(Some(b'9'), false);
    assert_eq!(all(&inbox), [b'3', b'4', b'5', LOST, b'9']);
    inbox.come(Some(b'x'), false);
    assert_eq!(all(&inbox), *b"x");
}
