//! What is said of two gateways that send under one number, as those of two machines made from one disk image do. Refuses
//! to know how they are told apart.

/// What to do about the gateway that is called `hub`.
pub(super) fn remedy(hub: &str) -> String {
    format!(
        "two gateways send as {hub}, and what one of them sends is refused: was one machine made from a copy of the \
         other's disk? Remove the files gateway-* in the state directory of one of them \
         (~/.local/state/scanhub, or what XDG_STATE_HOME or its service says) and start its gateway again"
    )
}
