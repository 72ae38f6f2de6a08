//! How many connections there may be, and how fast one address may open new ones.
//!
//! 1. Who connects too often waits for its turn, and is cut off where that is far away; connections that are open
//!    notice nothing of it.
//! 2. One address has at most half of the connections: there is room left for others.

use std::{
    collections::HashMap,
    net::{IpAddr, Ipv6Addr},
    num::NonZeroU32,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use super::pace::Pace;

/// A connection waits so long at most.
const PATIENCE: Duration = Duration::from_secs(1);
/// New connections that may come at once, in seconds of them.
const BURST_SECS: u32 = 4;

/// Caps on connections.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Crowding {
    /// Connections open at a time; half of them from one address.
    pub max_connections: usize,
    /// New connections a second from one address; four times as many may come at once.
    pub connections_per_sec: NonZeroU32,
}

/// Counts connections by address.
#[derive(Debug)]
pub(super) struct Crowd {
    max_connections: usize,
    pace: Pace<IpAddr>,
    counts: Arc<Mutex<Counts>>,
}

/// Connections that are open.
#[derive(Debug, Default)]
struct Counts {
    total: usize,
    by_address: HashMap<IpAddr, usize>,
}

/// The place of an open connection, until it is dropped.
#[derive(Debug)]
pub(super) struct Place {
    address: IpAddr,
    counts: Arc<Mutex<Counts>>,
}

/// Why a connection is cut off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Crowded {
    /// This address opens connections too fast.
    Fast,
    /// This address has too many open.
    ManyOfOne,
    /// All together have.
    Many,
}

impl Crowd {
    pub(super) fn new(crowding: &Crowding) -> Self {
        let per_sec = crowding.connections_per_sec.get();
        Self {
            max_connections: crowding.max_connections,
            pace: Pace::new(per_sec, per_sec.saturating_mul(BURST_SECS)),
            counts: Arc::default(),
        }
    }

    /// A place for a connection from this address, and how long it has to wait before it is served.
    pub(super) fn enter(
        &self,
        address: IpAddr,
        now: Instant,
    ) -> Result<(Place, Duration), Crowded> {
        let address = site(address);
        let mut counts = lock(&self.counts);
        if counts.total >= self.max_connections {
            return Err(Crowded::Many);
        }
        let of_one = counts.by_address.get(&address).copied().unwrap_or_default();
        if of_one >= self.max_connections.div_ceil(2) {
            return Err(Crowded::ManyOfOne);
        }
        let wait = self.pace.turn(address, now, PATIENCE).ok_or(Crowded::Fast)?;
        counts.by_address.insert(address, of_one + 1);
        counts.total += 1;
        Ok((Place { address, counts: Arc::clone(&self.counts) }, wait))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut counts = lock(&self.counts);
        counts.total -= 1;
        if let Some(of_one) = counts.by_address.get_mut(&self.address) {
            *of_one -= 1;
            if *of_one == 0 {
                counts.by_address.remove(&self.address);
            }
        }
    }
}

/// Whoever panicked here had counted whole connections.
fn lock(counts: &Mutex<Counts>) -> MutexGuard<'_, Counts> {
    counts.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Of IPv6, a site has 2^64 addresses and could use each once.
fn site(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() >> 64 << 64).into(),
        v4 @ IpAddr::V4(_) => v4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn crowd(max_connections: usize, per_sec: u32) -> Crowd {
        let connections_per_sec = NonZeroU32::new(per_sec).unwrap();
        Crowd::new(&Crowding { max_connections, connections_per_sec })
    }

    #[test]
    fn who_connects_too_often_waits_and_then_is_cut_off() {
        let (crowd, now) = (crowd(1000, 10), Instant::now());
        let enter = |last: u8| crowd.enter([127, 0, 0, last].into(), now).map(|(_, wait)| wait);
        let came: Vec<_> = (0..60).map(|_| enter(1)).collect();
        assert!(came[..40].iter().all(|wait| *wait == Ok(Duration::ZERO)), "{came:?}");
        assert_eq!(came[44], Ok(Duration::from_millis(500)));
        assert_eq!(came[49..51], [Ok(Duration::from_secs(1)), Err(Crowded::Fast)]);
        assert_eq!(enter(2), Ok(Duration::ZERO));
    }

    #[test]
    fn one_address_leaves_room_for_others() {
        let (crowd, now) = (crowd(4, 1000), Instant::now());
        let enter = |address: [u16; 8]| crowd.enter(address.into(), now);
        let [_first, second] = [1, 2].map(|last| enter([7, 7, 7, 7, 0, 0, 0, last]).unwrap().0);
        let third = enter([7, 7, 7, 7, 0, 0, 1, 3]).map(|_| ());
        assert_eq!(third, Err(Crowded::ManyOfOne), "the same site");
        let _others = [8, 9].map(|site| enter([site; 8]).unwrap().0);
        assert_eq!(enter([10; 8]).map(|_| ()), Err(Crowded::Many));
        drop(second);
        drop(enter([7; 8]).unwrap());
        assert_eq!(lock(&crowd.counts).by_address.len(), 3);
    }
}
