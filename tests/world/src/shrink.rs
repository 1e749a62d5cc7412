//! From a long list of actions that ends in a violation to a short one that ends in the same: halves are left out as long as
//! the same judge still complains, then quarters, down to single actions.

use crate::plan::Plan;

/// The shortest plan found for which `judge` says of some run the same as of `plan`, which is the name of who complains; `is_over`
/// ends the search early.
pub fn shrink(plan: &Plan, mut judge: impl FnMut(&Plan) -> Option<&'static str>) -> Plan {
    let Some(wanted) = judge(plan) else { return plan.clone() };
    let mut best = plan.clone();
    let mut piece = best.actions.len().div_ceil(2).max(1);
    loop {
        let mut from = 0;
        let mut is_shorter = false;
        while from < best.actions.len() {
            let to = (from + piece).min(best.actions.len());
            let mut less = best.clone();
            less.actions.drain(from..to);
            if judge(&less) == Some(wanted) {
                best = less;
                is_shorter = true;
            } else {
                from = to;
            }
        }
        match (piece, is_shorter) {
            (1, false) => return best,
            (1, true) => {}
            _ => piece = piece.div_ceil(2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_culprits_among_many_are_found() {
        let plan = (0..).map(|seed| Plan::of_seed(seed, 60)).find(|plan| plan.actions.len() > 40).unwrap();
        let culprits = [plan.actions[7].clone(), plan.actions[31].clone()];
        let mut runs = 0;
        let shrunk = shrink(&plan, |plan| {
            runs += 1;
            let has_all = culprits.iter().all(|culprit| plan.actions.contains(culprit));
            has_all.then_some("both")
        });
        assert_eq!(shrunk.actions, culprits);
        assert!(runs < 80, "{runs}");
        assert_eq!(shrink(&plan, |_| None), plan);
    }
}
