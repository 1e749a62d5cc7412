//! Which of the telegrams that were sent is which of those that were delivered: the pairing in order that leaves the
//! fewest losses, and then the fewest that nobody sent. Telegrams may be equal, so a search from the front would not do.

use crate::session::bench::{Received, Sent};

/// What a pairing leaves over.
pub(crate) struct Account<'a> {
    /// Sent, due, and not delivered.
    pub(crate) lost: Vec<&'a Sent>,
    /// Delivered, and not sent.
    pub(crate) wrong: Vec<&'a Received>,
}

/// Pairs `received` with `sent`, of which those that are `due` must be there.
pub(crate) fn align<'a>(
    sent: &'a [Sent],
    received: &'a [Received],
    is_due: impl Fn(&Sent) -> bool,
) -> Account<'a> {
    let same = |s: usize, r: usize| sent[s].telegram == received[r].telegram;
    // best[s][r]: (lost, wrong) of the rest from these on.
    let mut best = vec![vec![(0, 0); received.len() + 1]; sent.len() + 1];
    for s in (0..=sent.len()).rev() {
        for r in (0..=received.len()).rev() {
            let pass_sent = (s < sent.len()).then(|| {
                let (lost, wrong) = best[s + 1][r];
                (lost + usize::from(is_due(&sent[s])), wrong)
            });
            let pass_received = (r < received.len()).then(|| (best[s][r + 1].0, best[s][r + 1].1 + 1));
            let pair =
                (pass_sent.is_some() && pass_received.is_some() && same(s, r)).then(|| best[s + 1][r + 1]);
            best[s][r] = [pair, pass_sent, pass_received].into_iter().flatten().min().unwrap_or_default();
        }
    }
    let (mut s, mut r) = (0, 0);
    let mut account = Account { lost: Vec::new(), wrong: Vec::new() };
    while s < sent.len() || r < received.len() {
        let both = s < sent.len() && r < received.len();
        if both && same(s, r) && best[s][r] == best[s + 1][r + 1] {
            (s, r) = (s + 1, r + 1);
        } else if r < received.len() && best[s][r] == (best[s][r + 1].0, best[s][r + 1].1 + 1) {
            account.wrong.push(&received[r]);
            r += 1;
        } else {
            account.lost.extend(is_due(&sent[s]).then_some(&sent[s]));
            s += 1;
        }
    }
    account
}
