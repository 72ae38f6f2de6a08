//! The progress bar: one line at a terminal, nothing elsewhere; notes go above it.

use indicatif::{ProgressBar, ProgressStyle};
use lookalike::jobs::event::{Body, Report, ServerEvent};

use super::remote::Heard;

/// Steps of a whole bar.
const STEPS: u64 = 1000;

/// Shows how far a job is.
#[derive(Debug)]
pub(crate) struct Bar {
    progress: ProgressBar,
    stage: String,
    curve: String,
}

impl Bar {
    pub(crate) fn new() -> Self {
        let bar = ProgressBar::new(STEPS);
        // A message that would wrap at the terminal's edge is cut: of lines that wrap, parts stay on the screen.
        let style = "{elapsed_precise} {bar:16} {percent:>3}% {wide_msg}";
        if let Ok(style) = ProgressStyle::with_template(style) {
            bar.set_style(style);
        }
        Self { progress: bar, stage: String::new(), curve: String::new() }
    }

    /// What following a log hears next.
    pub(crate) fn heard(&mut self, heard: Heard<'_>) {
        match heard {
            Heard::Entry(event) => self.event(&event.body),
            Heard::Silence(text) => self.line(text),
        }
    }

    fn event(&mut self, body: &Body) {
        match body {
            Body::Worker(report) => self.report(report),
            Body::Server(ServerEvent::StateChanged { state, text, .. }) => {
                self.line(&format!("{state}: {text}"));
            }
            Body::Server(ServerEvent::Restarted { .. }) => {
                self.progress.set_position(0);
                self.curve.clear();
            }
        }
    }

    /// What the pipeline says next.
    pub(crate) fn report(&mut self, report: &Report) {
        match report {
            Report::Note { code, text } => self.line(&format!("{code}: {text}")),
            Report::Progress { stage, fraction, eta_secs } => {
                self.progress.set_position((fraction.clamp(0.0, 1.0) * STEPS as f64) as u64);
                self.stage = match eta_secs {
                    Some(secs) => format!("{stage}, {secs:.0} s to go"),
                    None => stage.clone(),
                };
                self.show();
            }
            Report::Sample(sample) => {
                let d2 = sample.d2.map(|d2| format!(", d2 {d2:.3}%")).unwrap_or_default();
                self.curve = format!("{} triangles{d2}", sample.triangles);
                self.show();
            }
            Report::Records { .. } | Report::Moves { .. } | Report::Artifact { .. } => {}
        }
    }

    /// A line above the bar.
    pub(crate) fn line(&self, text: &str) {
        if self.progress.is_hidden() {
            eprintln!("{text}");
        } else {
            self.progress.println(text);
        }
    }

    pub(crate) fn finish(&self) {
        self.progress.finish_and_clear();
    }

    fn show(&self) {
        self.progress.set_message(format!("{}: {}", self.stage, self.curve));
    }
}
