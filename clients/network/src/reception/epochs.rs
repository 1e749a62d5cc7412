//! The greatest epochs of the gateways that had the key, over restarts of the listener: what an older life sent is not
//! believed again. Losing the file loses no more than that. Refuses to know how they were learned.

use std::cmp::Reverse;
use std::collections::HashMap;

use crate::lan::Key;
use crate::lan::incoming::GATEWAYS;
use scanhub_schema::Failure;
use scanhub_shm::StateDirectory;

/// The file in which they are kept; nothing where there is no place for one.
pub(super) struct Epochs {
    state: Option<StateDirectory>,
    name: String,
}

impl Epochs {
    /// Those of gateways that have `key`.
    pub(super) fn of(key: &Key, state: Option<StateDirectory>) -> Epochs {
        Epochs { state, name: format!("heard-{}", key.name()) }
    }

    /// What was kept.
    ///
    /// As [`StateDirectory::read`]; what is no such line says nothing.
    pub(super) fn read(&self) -> Result<HashMap<u64, u32>, Failure> {
        let text = self.state.as_ref().map(|state| state.read(&self.name, LONGEST)).transpose()?.flatten();
        Ok(text.unwrap_or_default().lines().filter_map(parse).collect())
    }

    /// Keeps `epochs`, and what another listener kept meanwhile, of too many those.
    ///
    /// As [`StateDirectory::lock`] and [`StateDirectory::write`].
    pub(super) fn keep(&self, epochs: &HashMap<u64, u32>) -> Result<(), Failure> {
        let Some(state) = &self.state else { return Ok(()) };
        // Until the end of this: two listeners that merge at once would forget what one of them adds.
        let _turn = state.lock(&self.name)?;
        // One that cannot be used is replaced.
        let mut all = self.read().unwrap_or_default();
        for (&hub, &epoch) in epochs {
            let kept = all.entry(hub).or_default();
            *kept = epoch.max(*kept);
        }
        let mut all: Vec<_> = all.into_iter().collect();
        // Those that this listener knows, and of the others the youngest lives.
        all.sort_unstable_by_key(|&(hub, epoch)| (!epochs.contains_key(&hub), Reverse(epoch), hub));
        all.truncate(GATEWAYS);
        let mut lines: Vec<String> = all.iter().map(|(hub, epoch)| format!("{hub:016x} {epoch}\n")).collect();
        lines.sort_unstable();
        state.write(&self.name, &lines.concat())
    }
}

fn parse(line: &str) -> Option<(u64, u32)> {
    let (hub, epoch) = line.split_once(' ')?;
    Some((u64::from_str_radix(hub, 16).ok()?, epoch.parse().ok()?))
}

/// More gateways than one key has.
const LONGEST: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn listeners_that_keep_at_once_forget_nothing() {
        let root = tempfile::tempdir().unwrap();
        let epochs = || Epochs::of(&Key::new(&[1; 32]), Some(StateDirectory::at(root.path().join("d"))));
        std::thread::scope(|scope| {
            for listener in 0..8u64 {
                let epochs = epochs();
                scope.spawn(move || {
                    let keep = |n: u64| epochs.keep(&HashMap::from([(8 * n + listener, 1)])).unwrap();
                    (0..10).for_each(keep);
                });
            }
        });
        assert_eq!(epochs().read().unwrap().len(), 80);
    }

    #[test]
    fn no_more_are_kept_than_a_listener_knows() {
        let root = tempfile::tempdir().unwrap();
        let epochs = Epochs::of(&Key::new(&[1; 32]), Some(StateDirectory::at(root.path().join("d"))));
        let many = |from: u64, count: u64| (from..from + count).map(|hub| (hub, hub as u32 + 1)).collect();
        epochs.keep(&many(0, GATEWAYS as u64)).unwrap();
        epochs.keep(&many(50_000, 10)).unwrap();
        epochs.keep(&HashMap::from([(7, 1)])).unwrap();
        let kept = epochs.read().unwrap();
        assert_eq!((kept.len(), kept.contains_key(&10)), (GATEWAYS, false), "the oldest lives are forgotten");
        assert_eq!((kept.get(&7), kept.get(&50_009)), (Some(&1), Some(&50_010)));
    }

    #[test]
    fn the_greatest_of_all_listeners_is_kept() {
        let root = tempfile::tempdir().unwrap();
        let epochs = |key| Epochs::of(&Key::new(&[key; 32]), Some(StateDirectory::at(root.path().join("d"))));
        assert_eq!(epochs(1).read().unwrap(), HashMap::new());
        epochs(1).keep(&HashMap::from([(5, 7), (6, 1)])).unwrap();
        epochs(1).keep(&HashMap::from([(5, 6), (7, u32::MAX)])).unwrap();
        assert_eq!(epochs(1).read().unwrap(), HashMap::from([(5, 7), (6, 1), (7, u32::MAX)]));
        assert_eq!(epochs(2).read().unwrap(), HashMap::new(), "another key");
        std::fs::write(
            StateDirectory::at(root.path().join("d")).path(&epochs(1).name),
            "torn\n5 9 \nffff 3\n",
        )
        .unwrap();
        assert_eq!(epochs(1).read().unwrap(), HashMap::from([(0xffff, 3)]));
        assert_eq!(Epochs::of(&Key::new(&[1; 32]), None).keep(&HashMap::from([(5, 7)])), Ok(()));
    }
}
