//! Requests to end: Ctrl-C and SIGTERM.

use tokio::signal::unix::{SignalKind, signal};

/// Returns when this process is asked to end. Once called, the default (to die at once) is off for
/// good.
pub(crate) async fn asked_to_end() {
    let (Ok(mut interrupt), Ok(mut terminate)) =
        (signal(SignalKind::interrupt()), signal(SignalKind::terminate()))
    else {
        // Without handlers the default stays: the process dies at once.
        return std::future::pending().await;
    };
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
}
