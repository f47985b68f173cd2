//! How virtual time follows the wall clock, for clients that run in real time.

use std::time::{Duration, Instant};

use crate::time::{Span, Time};

/// How fast virtual time goes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Speed {
    /// So many virtual seconds in a second of the wall clock. Idle or not, the clock goes on, so
    /// the time-outs of both sides come when they should.
    Times(f64),
    /// As fast as the host can, but for a moment after every frame that a client got: then it goes
    /// 1:1, so that the client's answer does not come late in the device's eyes. Waits in which
    /// nobody has to answer (an erase, a heartbeat's period) are skipped through. Time never
    /// stops. Beware: a client that waits for wall-clock time between two requests lets much
    /// virtual time pass, and time-outs of the device may strike.
    Max,
}

impl std::str::FromStr for Speed {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        if text == "max" {
            return Ok(Self::Max);
        }
        match text.parse::<f64>() {
            Ok(times) if (MIN_TIMES..=MAX_TIMES).contains(&times) => Ok(Self::Times(times)),
            _ => Err(format!("`{text}` is neither `max` nor a number from {MIN_TIMES} to {MAX_TIMES}")),
        }
    }
}

const MIN_TIMES: f64 = 0.001;
const MAX_TIMES: f64 = 1000.0;
/// The longest step of the world, so that clients are served in time.
const MOST: Span = Span::from_millis(2);
/// How long an idle world sleeps on the wall clock before it goes on.
pub const NAP: Duration = Duration::from_millis(2);
/// The longest step at [`Speed::Max`].
const MOST_AT_MAX: Span = Span::from_millis(10);
/// The wall-clock time that a client gets to react to a frame at [`Speed::Max`].
const GRACE: Duration = Duration::from_millis(5);
/// A world that is further behind than this (of wall-clock time) does not catch up: the host is too
/// slow, or slept.
const PATIENCE: Duration = Duration::from_millis(100);

/// Says how far the world may go. The wall clock is passed in.
#[derive(Clone, Copy, Debug)]
pub struct Pacer {
    speed: Speed,
    /// A moment at which wall clock and virtual time belonged together.
    anchor: (Instant, Time),
    delivered: Option<Instant>,
}

impl Pacer {
    /// From this moment on.
    #[must_use]
    pub fn new(speed: Speed, wall: Instant, now: Time) -> Self {
        Self { speed, anchor: (wall, now), delivered: None }
    }

    /// A client has received a frame.
    pub fn delivered(&mut self, wall: Instant) {
        self.delivered = Some(wall);
    }

    /// How far a world that has come to `now` may go; `now` itself if it has to wait.
    pub fn target(&mut self, wall: Instant, now: Time) -> Time {
        let times = match self.speed {
            Speed::Times(times) => times,
            Speed::Max => {
                let waits = self.delivered.is_some_and(|at| wall.saturating_duration_since(at) < GRACE);
                if !waits {
                    self.anchor = (wall, now);
                    return now + MOST_AT_MAX;
                }
                1.0
            }
        };
        let due = self.due(wall, times);
        if due - now > scaled(PATIENCE, times) {
            self.anchor = (wall, now);
            return now + MOST;
        }
        due.max(now).min(now + MOST)
    }

    /// Whether a world in which no answer is due should go on to `target` now. If not, there is
    /// more to do at once after [`NAP`]: events of every millisecond are then processed two at a
    /// time.
    #[must_use]
    pub fn is_worth_it(&self, now: Time, target: Time) -> bool {
        match self.speed {
            Speed::Times(times) => target - now >= MOST.min(scaled(NAP, times)),
            Speed::Max => target > now,
        }
    }

    fn due(&self, wall: Instant, times: f64) -> Time {
        self.anchor.1 + scaled(wall.saturating_duration_since(self.anchor.0), times)
    }
}

/// Detects that the world does not keep the requested speed.
#[derive(Clone, Debug)]
pub struct Lag {
    speed: Speed,
    /// Where the present window began.
    since: Option<(Instant, Time)>,
    /// The pace that was reported last, in tenths of the requested speed.
    reported: u32,
}

/// How long the world is watched before the first report.
const WINDOW: Duration = Duration::from_secs(2);

impl Lag {
    /// Begins to watch.
    #[must_use]
    pub fn new(speed: Speed) -> Self {
        Self { speed, since: None, reported: 10 }
    }

    /// The world has come to `now`: a text where the pace has changed since the last one. At
    /// [`Speed::Max`] there is none to keep.
    pub fn check(&mut self, wall: Instant, now: Time) -> Option<String> {
        let Speed::Times(times) = self.speed else { return None };
        let (began, start) = *self.since.get_or_insert((wall, now));
        let took = wall.saturating_duration_since(began);
        if took < WINDOW {
            return None;
        }
        self.since = Some((wall, now));
        let wanted = scaled(took, times).0.max(1) as f64;
        let tenths = (((now - start).0 as f64 / wanted * 10.0).round() as u32).min(10);
        // A tenth more or less is no news, but being in time again is.
        if tenths.abs_diff(self.reported) < 2 && (tenths < 10 || self.reported == 10) {
            return None;
        }
        self.reported = tenths;
        Some(match tenths {
            10 => format!("the emulation keeps up again: {times} of real time"),
            _ => format!(
                "the host is too slow: the emulation runs at {:.1} of real time, not {times}",
                f64::from(tenths) / 10.0 * times
            ),
        })
    }
}

fn scaled(duration: Duration, times: f64) -> Span {
    // Rounding and the end of the range are harmless: it is a pace, not a measurement.
    Span((duration.as_secs_f64() * times * 1e12) as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The virtual time, in ms, after so many milliseconds of wall clock, if the pacing is asked
    /// every `tick`.
    fn run(speed: Speed, wall_ms: u64, tick: u64) -> u64 {
        let start = Instant::now();
        let mut pacer = Pacer::new(speed, start, Time(0));
        let mut now = Time(0);
        for ms in (0..=wall_ms).step_by(tick as usize) {
            let wall = start + Duration::from_millis(ms);
            loop {
                let target = pacer.target(wall, now);
                if target <= now || speed == Speed::Max {
                    now = target;
                    break;
                }
                now = target;
            }
        }
        now.0 / 1_000_000_000
    }

    #[test]
    fn follows_the_wall_clock() {
        assert_eq!(run(Speed::Times(1.0), 5_000, 1), 5_000);
        assert_eq!(run(Speed::Times(10.0), 500, 1), 5_000);
        assert_eq!(run(Speed::Times(0.5), 5_000, 10), 2_500);
    }

    #[test]
    fn at_max_every_look_takes_it_further() {
        assert_eq!(run(Speed::Max, 99, 1), 1_000);
    }

    #[test]
    fn at_max_a_client_gets_time_to_answer() {
        let start = Instant::now();
        let mut pacer = Pacer::new(Speed::Max, start, Time(0));
        let now = pacer.target(start, Time(0));
        assert_eq!(now, Time(0) + Span::from_millis(10));
        pacer.delivered(start);
        assert!(pacer.target(start, now) - now < Span::from_millis(1));
        let soon = start + Duration::from_millis(1);
        assert!(pacer.target(soon, now) - now <= Span::from_millis(1));
        let late = start + GRACE;
        assert_eq!(pacer.target(late, now), now + MOST_AT_MAX);
    }

    #[test]
    fn a_host_that_slept_does_not_race() {
        let start = Instant::now();
        let mut pacer = Pacer::new(Speed::Times(1.0), start, Time(0));
        let woken = start + Duration::from_secs(3600);
        let now = pacer.target(woken, Time(0));
        assert_eq!(now, Time(0) + MOST);
        assert_eq!(pacer.target(woken, now), now, "and waits for the wall clock again");
    }

    /// The reports about a world that makes so many milliseconds in each of so many seconds.
    fn lags(speed: Speed, paces: &[u64]) -> Vec<(usize, String)> {
        let start = Instant::now();
        let mut lag = Lag::new(speed);
        let (mut now, mut reports) = (Time(0), Vec::new());
        for (second, pace) in paces.iter().enumerate() {
            for tenth in 0..10_u64 {
                let wall = start + Duration::from_millis(1_000 * second as u64 + 100 * tenth);
                reports.extend(lag.check(wall, now).map(|text| (second, text)));
                now = now + Span::from_millis(pace / 10);
            }
        }
        reports
    }

    /// A loop without a pause would advance the world in each round, and use all of a core of the
    /// host.
    #[test]
    fn an_idle_world_goes_on_five_hundred_times_a_second_at_most() {
        for (speed, most) in [(1.0, 501), (0.25, 501), (10.0, 5_001)] {
            let start = Instant::now();
            let mut pacer = Pacer::new(Speed::Times(speed), start, Time(0));
            let (mut now, mut runs) = (Time(0), 0);
            for micros in (0..=1_000_000).step_by(10) {
                let target = pacer.target(start + Duration::from_micros(micros), now);
                if pacer.is_worth_it(now, target) {
                    now = target;
                    runs += 1;
                }
            }
            assert!(runs <= most && runs > most / 2, "{runs} times at speed {speed}");
            assert!(Time((speed * 1e12) as u64) - now <= MOST, "{now} at speed {speed}");
        }
    }

    #[test]
    fn a_slow_host_is_said_once_per_change() {
        let slow = lags(Speed::Times(1.0), &[1000, 1000, 600, 600, 600, 600, 600, 600, 1000, 1000, 1000]);
        let texts: Vec<&str> = slow.iter().map(|(_, text)| text.as_str()).collect();
        assert_eq!(texts.len(), 2, "{texts:?}");
        assert!(texts[0].contains("0.6 of real time"), "{texts:?}");
        assert!(texts[1].contains("keeps up again"), "{texts:?}");
        assert_eq!(lags(Speed::Times(1.0), &[1000; 20]), []);
        assert_eq!(lags(Speed::Max, &[10; 20]), []);
        let half = lags(Speed::Times(0.5), &[250; 20]);
        assert_eq!(half.len(), 1);
        assert!(half[0].1.contains("0.2 of real time") || half[0].1.contains("0.3 of"), "{half:?}");
    }

    #[test]
    fn texts() {
        assert_eq!("max".parse(), Ok(Speed::Max));
        assert_eq!("1".parse(), Ok(Speed::Times(1.0)));
        assert_eq!("0.25".parse(), Ok(Speed::Times(0.25)));
        for text in ["", "0", "-1", "nan", "inf", "1e9", "fast"] {
            assert!(text.parse::<Speed>().is_err(), "{text}");
        }
    }
}
