//! How much one principal may ask for at once: requests a second, and open streams.
//!
//! Workers are not counted: what they ask follows from the jobs that were accepted.

use std::{
    collections::HashMap,
    net::IpAddr,
    num::NonZeroU32,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use governor::{
    DefaultKeyedRateLimiter, Quota, RateLimiter,
    clock::{Clock, DefaultClock},
};

use crate::service::pace::Pace;

/// Principals whose buckets are full again are forgotten when there are more than this.
const MANY: usize = 10_000;
/// Refusals of strangers from one address that are answered at once, and how many more a second.
const STRANGERS: (u32, u32) = (1000, 50);
/// An answer is held back so long at most.
const PATIENCE: Duration = Duration::from_secs(2);

/// Caps on what one principal may ask for at once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rates {
    /// Requests a second; twice as many may come at once.
    pub requests_per_sec: NonZeroU32,
    /// Uploads, downloads and logs that are open at a time.
    pub max_streams: usize,
    /// Bytes of uploads of one owner, in MiB a second.
    pub upload_mib_per_sec: NonZeroU32,
}

impl Rates {
    /// So many bytes have a turn in the pace of uploads.
    pub(in crate::service) const TURN: usize = 64 << 10;

    /// How fast the uploads of each owner may come; a second's worth at once.
    pub(super) fn uploads(&self) -> Pace<String> {
        let per_sec = self.upload_mib_per_sec.get().saturating_mul(((1 << 20) / Self::TURN) as u32);
        Pace::new(per_sec, per_sec)
    }
}

/// Counts requests and streams by owner and name.
#[derive(Debug)]
pub(super) struct Limiter {
    rates: Rates,
    requests: DefaultKeyedRateLimiter<String>,
    streams: Arc<Mutex<HashMap<String, usize>>>,
    strangers: Pace<Option<IpAddr>>,
}

/// An open stream, until it is dropped.
#[derive(Debug)]
pub(super) struct OpenStream {
    key: String,
    streams: Arc<Mutex<HashMap<String, usize>>>,
}

impl Limiter {
    pub(super) fn new(rates: Rates) -> Self {
        let burst = rates.requests_per_sec.saturating_mul(NonZeroU32::MIN.saturating_add(1));
        let quota = Quota::per_second(rates.requests_per_sec).allow_burst(burst);
        Self {
            rates,
            requests: RateLimiter::keyed(quota),
            streams: Arc::default(),
            strangers: Pace::new(STRANGERS.1, STRANGERS.0),
        }
    }

    /// Counts a request; the time to wait when it is one too many.
    pub(super) fn request(&self, key: &str) -> Result<(), Duration> {
        if self.requests.len() > MANY {
            self.requests.retain_recent();
        }
        let clock = DefaultClock::default();
        let checked = self.requests.check_key(&key.to_owned());
        checked.map_err(|early| early.wait_time_from(clock.now()))
    }

    /// How long the refusal of a stranger is held back: at once only a few are told.
    pub(super) fn stranger(&self, address: Option<IpAddr>) -> Duration {
        self.strangers.turn(address, Instant::now(), PATIENCE).unwrap_or(PATIENCE)
    }

    /// Counts a stream as long as the answer lives; how many may be open when it is one too many.
    pub(super) fn stream(&self, key: &str) -> Result<OpenStream, usize> {
        let mut streams = self.streams.lock().unwrap_or_else(PoisonError::into_inner);
        let open = streams.entry(key.to_owned()).or_default();
        if *open >= self.rates.max_streams {
            return Err(self.rates.max_streams);
        }
        *open += 1;
        Ok(OpenStream { key: key.to_owned(), streams: Arc::clone(&self.streams) })
    }
}

impl Drop for OpenStream {
    fn drop(&mut self) {
        let mut streams = self.streams.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(open) = streams.get_mut(&self.key) {
            *open -= 1;
            if *open == 0 {
                streams.remove(&self.key);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rates(requests_per_sec: NonZeroU32) -> Rates {
        Rates { requests_per_sec, max_streams: 1, upload_mib_per_sec: NonZeroU32::MIN }
    }

    #[test]
    fn each_principal_has_its_own_share() {
        let requests_per_sec = NonZeroU32::new(2).unwrap();
        let limiter = Limiter::new(rates(requests_per_sec));
        for _ in 0..4 {
            limiter.request("ann").unwrap();
        }
        let wait = limiter.request("ann").unwrap_err();
        assert!(wait > Duration::ZERO && wait <= Duration::from_millis(500), "{wait:?}");
        limiter.request("bob").unwrap();
        let open = limiter.stream("ann").unwrap();
        assert_eq!(limiter.stream("ann").unwrap_err(), 1);
        drop((open, limiter.stream("bob").unwrap()));
        limiter.stream("ann").unwrap();
        assert!(limiter.streams.lock().unwrap().is_empty());
    }

    #[test]
    fn strangers_are_answered_ever_later() {
        let limiter = Limiter::new(rates(NonZeroU32::MIN));
        let [here, there] = [1, 2].map(|last| Some(IpAddr::from([127, 0, 0, last])));
        let waits: Vec<Duration> = (0..2000).map(|_| limiter.stranger(here)).collect();
        assert_eq!(waits[..1000].iter().max(), Some(&Duration::ZERO));
        assert_eq!(waits[1999], PATIENCE);
        assert_eq!(limiter.stranger(there), Duration::ZERO);
    }
}
