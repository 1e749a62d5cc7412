//! File with the highest epochs of the gateways that have the key. With this file, datagrams of an older run are
//! refused even after a restart of the listener.

use std::cmp::Reverse;
use std::collections::HashMap;

use scanhub_schema::Failure;
use scanhub_shm::StateDirectory;

use crate::lan::{Key, MAX_EPOCHS};

/// File with the epochs. Without a state directory, the epochs are not kept.
pub(super) struct Epochs {
    state: Option<StateDirectory>,
    name: String,
}

impl Epochs {
    /// Returns the file for gateways with `key`.
    pub(super) fn of(key: &Key, state: Option<StateDirectory>) -> Epochs {
        Epochs { state, name: format!("epochs-{}", key.name()) }
    }

    /// Returns the epochs. Invalid lines are ignored.
    ///
    /// # Errors
    ///
    /// Returns the same errors as [`StateDirectory::read`].
    pub(super) fn read(&self) -> Result<HashMap<u64, u32>, Failure> {
        let text = self.state.as_ref().map(|state| state.read(&self.name, MAX_LEN)).transpose()?.flatten();
        Ok(text.unwrap_or_default().lines().filter_map(parse).collect())
    }

    /// Saves `epochs` together with the epochs that other listeners have saved, as far as there is room.
    ///
    /// # Errors
    ///
    /// Returns the same errors as [`StateDirectory::lock`] and [`StateDirectory::write`].
    pub(super) fn store(&self, epochs: &HashMap<u64, u32>) -> Result<(), Failure> {
        let Some(state) = &self.state else { return Ok(()) };
        // Without the lock, if two listeners saved at the same time, the epochs of one of them would be lost.
        let _lock = state.lock(&self.name)?;
        // A file that cannot be read is replaced.
        let mut all = self.read().unwrap_or_default();
        for (&hub, &epoch) in epochs {
            let kept = all.entry(hub).or_default();
            *kept = epoch.max(*kept);
        }
        let mut all: Vec<_> = all.into_iter().collect();
        // Keep the epochs of this listener first, and then the highest epochs of other listeners.
        all.sort_unstable_by_key(|&(hub, epoch)| (!epochs.contains_key(&hub), Reverse(epoch), hub));
        all.truncate(MAX_EPOCHS);
        let mut lines: Vec<String> = all.iter().map(|(hub, epoch)| format!("{hub:016x} {epoch}\n")).collect();
        lines.sort_unstable();
        state.write(&self.name, &lines.concat())
    }
}

fn parse(line: &str) -> Option<(u64, u32)> {
    let (hub, epoch) = line.split_once(' ')?;
    Some((u64::from_str_radix(hub, 16).ok()?, epoch.parse().ok()?))
}

/// Maximum length of the file, in bytes. A file with the maximum number of epochs is shorter.
const MAX_LEN: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn concurrent_listeners_lose_no_epochs() {
        let root = tempfile::tempdir().unwrap();
        let epochs = || Epochs::of(&Key::new(&[1; 32]), Some(StateDirectory::at(root.path().join("d"))));
        std::thread::scope(|scope| {
            for listener in 0..8u64 {
                let epochs = epochs();
                scope.spawn(move || {
                    let keep = |n: u64| epochs.store(&HashMap::from([(8 * n + listener, 1)])).unwrap();
                    (0..10).for_each(keep);
                });
            }
        });
        assert_eq!(epochs().read().unwrap().len(), 80);
    }

    #[test]
    fn number_of_kept_epochs_is_limited() {
        let root = tempfile::tempdir().unwrap();
        let epochs = Epochs::of(&Key::new(&[1; 32]), Some(StateDirectory::at(root.path().join("d"))));
        let many = |from: u64, count: u64| (from..from + count).map(|hub| (hub, hub as u32 + 1)).collect();
        epochs.store(&many(0, MAX_EPOCHS as u64)).unwrap();
        epochs.store(&many(50_000, 10)).unwrap();
        epochs.store(&HashMap::from([(7, 1)])).unwrap();
        let kept = epochs.read().unwrap();
        assert_eq!((kept.len(), kept.contains_key(&10)), (MAX_EPOCHS, false), "the oldest runs are dropped");
        assert_eq!((kept.get(&7), kept.get(&50_009)), (Some(&1), Some(&50_010)));
    }

    #[test]
    fn highest_epoch_of_all_listeners_is_kept() {
        let root = tempfile::tempdir().unwrap();
        let epochs = |key| Epochs::of(&Key::new(&[key; 32]), Some(StateDirectory::at(root.path().join("d"))));
        assert_eq!(epochs(1).read().unwrap(), HashMap::new());
        epochs(1).store(&HashMap::from([(5, 7), (6, 1)])).unwrap();
        epochs(1).store(&HashMap::from([(5, 6), (7, u32::MAX)])).unwrap();
        assert_eq!(epochs(1).read().unwrap(), HashMap::from([(5, 7), (6, 1), (7, u32::MAX)]));
        assert_eq!(epochs(2).read().unwrap(), HashMap::new(), "another key");
        std::fs::write(
            StateDirectory::at(root.path().join("d")).path(&epochs(1).name),
            "torn\n5 9 \nffff 3\n",
        )
        .unwrap();
        assert_eq!(epochs(1).read().unwrap(), HashMap::from([(0xffff, 3)]));
        assert_eq!(Epochs::of(&Key::new(&[1; 32]), None).store(&HashMap::from([(5, 7)])), Ok(()));
    }
}
