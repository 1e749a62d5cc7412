//! Join of the samples of two topics that a hub computes from the same telegram, such as `scan` and `foreground`. The
//! two samples arrive one after the other, and either one may be missing.

use std::collections::VecDeque;

use scanhub_schema::Header;

/// Pairs of samples with the same `boot` and `seq`, from two topics of one sensor. Callers pass the time.
///
/// A sample waits for its partner until the partner's topic sends a later sample, which takes one period. If that topic
/// is silent, the sample waits for 1 s.
///
/// # Examples
///
/// ```
/// use scanhub_client::Header;
/// use scanhub_client::streams::Join;
///
/// let header = |seq| Header { seq, ..Header::default() };
/// let mut join = Join::default();
/// assert_eq!(join.first(&header(1), "scan 1", 0), None);
/// assert_eq!(join.first(&header(2), "scan 2", 13), None);
/// assert_eq!(join.second(&header(2), "foreground 2", 15), Some(("scan 2", "foreground 2")));
/// assert_eq!(join.dropped(), 1, "foreground 1 was lost");
/// ```
#[derive(Debug)]
pub struct Join<A, B> {
    first: VecDeque<WaitingSample<A>>,
    second: VecDeque<WaitingSample<B>>,
    dropped: u64,
}

#[derive(Debug)]
struct WaitingSample<T> {
    boot: u64,
    seq: u64,
    since_ns: u64,
    sample: T,
}

/// Maximum number of samples of a topic that wait for their partners.
const MAX_WAITING: usize = 64;
/// Time after which a sample is dropped if the other topic is silent, in ns.
const PARTNER_TIMEOUT_NS: u64 = 1_000_000_000;

impl<A, B> Default for Join<A, B> {
    fn default() -> Join<A, B> {
        Join { first: VecDeque::new(), second: VecDeque::new(), dropped: 0 }
    }
}

impl<A, B> Join<A, B> {
    /// Adds a sample of the first topic that was received at `now_ns`. Returns the pair if the sample's partner has
    /// arrived.
    pub fn first(&mut self, header: &Header, sample: A, now_ns: u64) -> Option<(A, B)> {
        match partner(&mut self.second, header, &mut self.dropped) {
            Some(partner) => Some((sample, partner)),
            None => {
                wait(&mut self.first, header, sample, now_ns, &mut self.dropped);
                None
            }
        }
    }

    /// Adds a sample of the second topic that was received at `now_ns`. Returns the pair if the sample's partner has
    /// arrived.
    pub fn second(&mut self, header: &Header, sample: B, now_ns: u64) -> Option<(A, B)> {
        match partner(&mut self.first, header, &mut self.dropped) {
            Some(partner) => Some((partner, sample)),
            None => {
                wait(&mut self.second, header, sample, now_ns, &mut self.dropped);
                None
            }
        }
    }

    /// Drops the samples that have waited for longer than 1 s. Call this method only after all samples that have
    /// arrived were added: after a pause of the program, a partner may be among them.
    pub fn expire(&mut self, now_ns: u64) {
        self.dropped += expire(&mut self.first, now_ns) + expire(&mut self.second, now_ns);
    }

    /// Returns the number of samples that were dropped because they have no partner.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }
}

/// Removes the partner of the sample with this header from `waiting`, and drops the samples before it. The samples of
/// each topic are in order, so the partners of the dropped samples are lost.
fn partner<T>(waiting: &mut VecDeque<WaitingSample<T>>, header: &Header, dropped: &mut u64) -> Option<T> {
    let is_earlier = |one: &&WaitingSample<T>| one.boot == header.boot && one.seq < header.seq;
    let found = waiting.iter().position(|one| (one.boot, one.seq) == (header.boot, header.seq));
    let earlier = found.unwrap_or_else(|| waiting.iter().take_while(is_earlier).count());
    waiting.drain(..earlier);
    *dropped += earlier as u64;
    found.and_then(|_| waiting.pop_front()).map(|one| one.sample)
}

fn wait<T>(
    waiting: &mut VecDeque<WaitingSample<T>>,
    header: &Header,
    sample: T,
    since_ns: u64,
    dropped: &mut u64,
) {
    if waiting.len() == MAX_WAITING {
        waiting.pop_front();
        *dropped += 1;
    }
    waiting.push_back(WaitingSample { boot: header.boot, seq: header.seq, since_ns, sample });
}

/// Drops samples that have waited too long. Returns their number.
fn expire<T>(waiting: &mut VecDeque<WaitingSample<T>>, now_ns: u64) -> u64 {
    let is_old = |one: &&WaitingSample<T>| now_ns.saturating_sub(one.since_ns) > PARTNER_TIMEOUT_NS;
    let old = waiting.iter().take_while(is_old).count();
    waiting.drain(..old);
    old as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(boot: u64, seq: u64) -> Header {
        Header { boot, seq, ..Header::default() }
    }

    #[test]
    fn pairs_samples_whichever_arrives_first() {
        let mut join = Join::default();
        assert_eq!(join.second(&header(1, 4), 'b', 0), None);
        assert_eq!(join.first(&header(1, 4), 'a', 1), Some(('a', 'b')));
        // Many samples of one topic arrive, and then many of the other one.
        (5..37).for_each(|seq| assert_eq!(join.first(&header(1, seq), 'a', 2), None));
        (5..37).for_each(|seq| assert_eq!(join.second(&header(1, seq), 'b', 3), Some(('a', 'b'))));
        assert_eq!((join.dropped(), join.first.len() + join.second.len()), (0, 0));
    }

    #[test]
    fn drops_unpaired_sample_when_next_partner_arrives() {
        let mut join = Join::default();
        for seq in 1..=3 {
            assert_eq!(join.first(&header(1, seq), seq, 0), None);
        }
        assert_eq!(join.second(&header(1, 3), 30, 0), Some((3, 30)));
        assert_eq!(join.dropped(), 2);
        assert_eq!(join.first(&header(1, 4), 4, 0), None);
        assert_eq!(join.second(&header(1, 5), 50, 0), None);
        assert_eq!((join.dropped(), join.first.len(), join.second.len()), (3, 0, 1));
        assert_eq!(join.first(&header(1, 5), 5, 0), Some((5, 50)));
    }

    #[test]
    fn samples_of_different_hub_runs_are_not_paired() {
        let mut join = Join::default();
        assert_eq!(join.first(&header(1, 7), 'a', 0), None);
        assert_eq!(join.first(&header(2, 0), 'c', 0), None);
        assert_eq!(join.second(&header(2, 7), 'x', 0), None);
        assert_eq!(join.second(&header(1, 7), 'b', 0), Some(('a', 'b')), "the hub was restarted in between");
        assert_eq!(join.dropped(), 0);
        assert_eq!(join.first(&header(2, 7), 'y', 0), Some(('y', 'x')));
    }

    #[test]
    fn unpaired_samples_are_dropped_by_age_and_count() {
        let mut join = Join::<u64, u64>::default();
        join.first(&header(1, 1), 1, 0);
        join.first(&header(1, 2), 2, 10);
        join.expire(PARTNER_TIMEOUT_NS);
        assert_eq!(join.dropped(), 0);
        join.expire(PARTNER_TIMEOUT_NS + 1);
        assert_eq!((join.dropped(), join.first.len()), (1, 1));
        for seq in 3..3 + MAX_WAITING as u64 {
            join.first(&header(1, seq), seq, 20);
        }
        assert_eq!((join.dropped(), join.first.len()), (2, MAX_WAITING));
    }
}
