//! The processes that have joined a domain, running and dead. Only counts them: the next hub cleans up after dead ones.

use std::path::Path;

use iceoryx2::node::NodeState;
use iceoryx2::prelude::CallbackProgression;

use super::{Node, config};
use crate::{Domain, Failure, access};

/// Processes that joined a domain.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Nodes {
    /// Those that live.
    pub alive: usize,
    /// Those that ended without leaving; what they had is still there.
    pub dead: usize,
}

/// Returns the processes in `domain`; none if there is no such domain.
///
/// # Errors
///
/// [`Kind::Failed`](crate::Kind) with owner, mode and remedy if the directory is another user's.
pub fn nodes(domain: &Domain) -> Result<Nodes, Failure> {
    at(domain.root())
}

/// The same of the domain in `root`.
pub(super) fn at(root: &Path) -> Result<Nodes, Failure> {
    let mut nodes = Nodes::default();
    let Some(config) = config(root)? else { return Ok(nodes) };
    let listed = Node::list(&config, |state| {
        match state {
            NodeState::Alive(_) => nodes.alive += 1,
            NodeState::Dead(_) => nodes.dead += 1,
            NodeState::Inaccessible(_) | NodeState::Undefined(_) => {}
        }
        CallbackProgression::Continue
    });
    listed.map_err(|error| access::failure(root, format!("cannot list processes: {error:?}")))?;
    Ok(nodes)
}
