//! Flags of where traces go.

use clap::Args;
use http::Uri;

/// Also turn the export on, as OpenTelemetry has it; the first that is set holds.
const VARIABLES: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT"];
/// Turns it off again, where it says `true`.
const DISABLED: &str = "OTEL_SDK_DISABLED";

/// Flags of `lookalike serve` about traces.
#[derive(Args, Clone, Debug)]
pub(crate) struct TraceArgs {
    /// Export traces to an OpenTelemetry collector that takes OTLP over gRPC, http://HOST:4317. Default: the URL in
    /// OTEL_EXPORTER_OTLP_ENDPOINT, else none.
    #[arg(long, env = "LOOKALIKE_OTLP_ENDPOINT", value_name = "URL")]
    otlp_endpoint: Option<String>,
}

impl TraceArgs {
    /// The collector's address, if there is one; `variable` reads the environment. Adds what is wrong to `faults`.
    pub(super) fn check(
        self,
        variable: impl Fn(&str) -> Option<String>,
        faults: &mut Vec<String>,
    ) -> Option<String> {
        if variable(DISABLED).is_some_and(|text| text.eq_ignore_ascii_case("true")) {
            return None;
        }
        let given = self.otlp_endpoint.map(|url| ("--otlp-endpoint", url));
        let standard = VARIABLES.iter().map(|name| Some((*name, variable(name)?)));
        let is_url = |(_, url): &(&str, String)| !url.is_empty();
        let (place, url) = std::iter::once(given).chain(standard).flatten().find(is_url)?;
        if is_collector(&url) {
            return Some(url);
        }
        // The URL may hold a password.
        let text = "use http://HOST:PORT or https://HOST:PORT of a collector that takes OTLP over gRPC, without a path";
        faults.push(format!("{place}: {text}"));
        None
    }
}

fn is_collector(url: &str) -> bool {
    let Ok(url) = url.parse::<Uri>() else { return false };
    let is_bare = url.path_and_query().is_none_or(|path| path == "/");
    let host = url.authority().filter(|a| !a.as_str().contains('@')).map_or("", |a| a.host());
    matches!(url.scheme_str(), Some("http" | "https")) && is_bare && !host.is_empty()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(flag: Option<&str>, env: &[(&str, &str)]) -> (Option<String>, Vec<String>) {
        let mut faults = Vec::new();
        let args = TraceArgs { otlp_endpoint: flag.map(Into::into) };
        let variable = |name: &str| Some(env.iter().find(|row| row.0 == name)?.1.to_owned());
        (args.check(variable, &mut faults), faults)
    }

    #[test]
    fn flags_win_over_the_standard_variables() {
        let [traces, all] = VARIABLES;
        type Case<'a> = (Option<&'a str>, &'a [(&'a str, &'a str)], Option<&'a str>);
        let table: [Case<'_>; 8] = [
            (None, &[], None),
            (Some(""), &[(all, "")], None),
            (None, &[(all, "http://a:4317")], Some("http://a:4317")),
            (None, &[(all, "http://a:4317"), (traces, "https://b")], Some("https://b")),
            (Some("http://c:1/"), &[(traces, "https://b")], Some("http://c:1/")),
            (Some("http://[::1]:4317"), &[], Some("http://[::1]:4317")),
            (Some("http://c:1"), &[(DISABLED, "false")], Some("http://c:1")),
            (Some("http://c:1"), &[(traces, "nonsense"), (DISABLED, "True")], None),
        ];
        for (flag, env, wanted) in table {
            assert_eq!(check(flag, env), (wanted.map(Into::into), vec![]), "{flag:?} {env:?}");
        }
    }

    #[test]
    fn what_is_no_collector_is_told_without_its_secrets() {
        for bad in [
            "a",
            "a:4317",
            "ftp://a",
            "http://u:hush@a:4317",
            "http://a:4318/v1/traces",
            "http://:4317",
        ] {
            let (url, faults) = check(Some(bad), &[]);
            assert!(url.is_none() && faults.len() == 1, "{bad}: {faults:?}");
            assert!(
                faults[0].starts_with("--otlp-endpoint: use http://")
                    && !faults[0].contains("hush")
            );
        }
        let (_, faults) = check(None, &[(VARIABLES[1], "hush")]);
        assert!(faults[0].starts_with(VARIABLES[1]) && !faults[0].contains("hush"), "{faults:?}");
    }
}
