//! Tests of access control with certificates and users in Zenoh's own configuration. The tests create the certificates.

use std::process::Command;

use crate::testkit::{INT, Program, TestEnv, output};
use crate::{address, bridge, bridge_without_peer, refusal_count};

/// Runs `openssl` in the test's directory.
fn run_openssl(env: &TestEnv, words: &str) {
    let output = output(Command::new("openssl").args(words.split(' ')).current_dir(env.path("")));
    let output = output.expect("openssl is installed");
    assert!(output.status.success(), "openssl {words}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Creates an authority `ca`, and a certificate of this authority for each name. The certificates are for the loopback
/// address.
fn make_certificates(env: &TestEnv, ca: &str, names: &[&str]) {
    run_openssl(
        env,
        &format!("req -x509 -newkey rsa:2048 -nodes -keyout {ca}.key -out {ca}.pem -days 2 -subj /CN={ca}"),
    );
    env.file("ext", "subjectAltName=IP:127.0.0.1,DNS:localhost\nextendedKeyUsage=serverAuth,clientAuth\n");
    for name in names {
        run_openssl(
            env,
            &format!("req -newkey rsa:2048 -nodes -keyout {name}.key -out {name}.csr -subj /CN={name}"),
        );
        run_openssl(
            env,
            &format!(
                "x509 -req -in {name}.csr -CA {ca}.pem -CAkey {ca}.key -CAcreateserial -out {name}.pem -days 2 -extfile ext"
            ),
        );
    }
}

/// Writes a Zenoh configuration with mutual TLS, the authority `ca` and the certificate `own`. Returns its path.
fn tls(env: &TestEnv, file: &str, ca: &str, own: &str) -> String {
    let path = |name: &str| env.path_argument(name);
    let (ca, certificate, key) =
        (path(&format!("{ca}.pem")), path(&format!("{own}.pem")), path(&format!("{own}.key")));
    env.file(
        file,
        format!(
            "{{ transport: {{ link: {{ tls: {{ enable_mtls: true, root_ca_certificate: '{ca}', \
             listen_certificate: '{certificate}', listen_private_key: '{key}', \
             connect_certificate: '{certificate}', connect_private_key: '{key}' }} }} }} }}"
        ),
    )
}

fn await_ready(program: &mut Program) {
    crate::wait_until_linked(program);
}

/// Waits until the program reports this finding about a failed connection, with a message and a remedy.
fn await_finding(program: &mut Program, finding: &str) {
    let line = program.await_line("the reason", |line| {
        line["class"] == "bridge_link" && line["state"] == "failing" && line["finding"] == finding
    });
    assert!(line["remedy"].is_string() && line["message"].is_string(), "{line}");
}

/// Runs `doctor` and `bridge --check` with this address and configuration. Checks that both programs fail with the same
/// finding, and returns this finding.
fn check_finding(env: &TestEnv, at: &str, config: &str) -> String {
    let doctor = env.run(&["doctor", "--json", "--bridge", at, "--bridge-config", config]);
    assert_eq!(doctor.exit_code, Some(5), "{doctor}");
    let found = doctor.of_class("check").into_iter().find(|line| line["name"] == "bridge");
    let finding = found.unwrap_or_else(|| panic!("nothing of the bridge: {doctor}"))["finding"].to_string();
    let outcome = env.run(&["bridge", "--check", "--json", "--connect", at, "--config", config]);
    assert_eq!(outcome.exit_code, Some(5), "{outcome}");
    assert_eq!(outcome.of_class("bridge_check")[0]["finding"].to_string(), finding);
    finding
}

#[test]
fn only_certificates_of_the_authority_can_connect() {
    let (env, other) = (TestEnv::new(), TestEnv::new());
    make_certificates(&env, "ca", &["robot", "desk"]);
    make_certificates(&env, "stranger", &["thief"]);
    let at = address("tls");
    let of = |file: &str, ca: &str, own: &str| tls(&env, file, ca, own);
    let (mut robot, _) = bridge(&env, &["--listen", &at, "--config", &of("robot.json5", "ca", "robot")]);
    let desk = of("desk.json5", "ca", "desk");
    let (mut here, _) = bridge(&other, &["--connect", &at, "--publish", "--config", &desk]);
    await_ready(&mut here);
    await_ready(&mut robot);
    assert_eq!(here.end(INT).exit_code, Some(0));
    // The peer with the first configuration does not trust the robot's authority. The robot does not trust the
    // authority of the peer with the second configuration.
    for (file, ca) in [("a.json5", "stranger"), ("b.json5", "ca")] {
        let config = of(file, ca, "thief");
        let mut intruder = bridge_without_peer(&other, &["--connect", &at, "--publish", "--config", &config]);
        await_finding(&mut intruder, "the certificates do not match");
        assert_eq!(intruder.end(INT).of_class("bridge_published").len(), 0);
    }
    // The robot only sends. It reports the finding about a refused peer, and counts the refused connection.
    let line = robot.await_line("the refusal", |line| {
        line["class"] == "bridge_link"
            && line["finding"] == "a client was refused: the certificates do not match"
    });
    let remedy = line["remedy"].as_str().unwrap_or_default();
    assert!(remedy.contains("connect_certificate") && !remedy.contains("--connect"), "{line}");
    robot.await_line("its count", |line| {
        line["class"] == "bridge_refused" && line["connection"].as_u64() > Some(0)
    });
    let outcome = robot.end(INT);
    assert!(refusal_count(&outcome, "connection") > 0, "{outcome}");
    let outcome = other.run(&[
        "bridge",
        "--json",
        "--connect",
        &at,
        "--config",
        &other.file("none.json5", "{ transport: { link: { tls: { root_ca_certificate: '/nowhere' } } } }"),
    ]);
    assert_eq!(outcome.exit_code, Some(78), "{outcome}");
}

#[test]
fn wrong_or_missing_password_is_refused() {
    let (env, other) = (TestEnv::new(), TestEnv::new());
    let users = env.file("users", "robot:secret\ndesk:word\n");
    let auth = |file: &str, user: &str, password: &str, more: &str| {
        let text = format!(
            "{{ transport: {{ auth: {{ usrpwd: {{ user: '{user}', password: '{password}'{more} }} }} }} }}"
        );
        env.file(file, text)
    };
    let at = address("tcp");
    let listens = auth("robot.json5", "robot", "secret", &format!(", dictionary_file: '{users}'"));
    let (mut robot, _) = bridge(&env, &["--listen", &at, "--config", &listens]);
    let (mut here, _) =
        bridge(&other, &["--connect", &at, "--publish", "--config", &auth("desk.json5", "desk", "word", "")]);
    await_ready(&mut here);
    await_ready(&mut robot);
    assert_eq!(here.end(INT).exit_code, Some(0));
    let wrong = [
        (auth("guess.json5", "desk", "guess", ""), "the router refused the user or the password"),
        (auth("nobody.json5", "nobody", "word", ""), "the router refused the user or the password"),
        (env.file("none.json5", "{}"), "the router requires a user and a password"),
    ];
    for (config, finding) in &wrong {
        let mut intruder = bridge_without_peer(&other, &["--connect", &at, "--publish", "--config", config]);
        await_finding(&mut intruder, finding);
        let outcome = intruder.end(INT);
        assert_eq!((outcome.exit_code, outcome.of_class("bridge_ready").len()), (Some(0), 0), "{outcome}");
    }
    assert!(check_finding(&other, &at, &wrong[0].0).contains(wrong[0].1));
    await_finding(&mut robot, "a client was refused: its user or password is wrong or missing");
}

/// Creates a configuration with a self-signed certificate for CN=robot that was valid on one day in 2024.
fn expired_config(env: &TestEnv) -> String {
    env.file("index", "");
    env.file("serial", "01\n");
    env.file(
        "authority.cnf",
        "[ca]\ndefault_ca=own\n[own]\ndatabase=index\nserial=serial\nnew_certs_dir=.\ndefault_md=sha256\npolicy=any\n\
         [any]\ncommonName=supplied\n",
    );
    run_openssl(env, "req -newkey rsa:2048 -nodes -keyout old.key -out old.csr -subj /CN=robot");
    run_openssl(
        env,
        "ca -batch -selfsign -config authority.cnf -keyfile old.key -in old.csr -out old.pem -notext \
         -startdate 20240101000000Z -enddate 20240102000000Z",
    );
    tls(env, "old.json5", "old", "old")
}

#[test]
fn expired_certificate_is_reported_with_its_date() {
    let env = TestEnv::new();
    let config = expired_config(&env);
    let at = address("tls");
    for flag in ["--listen", "--connect"] {
        let outcome = env.run(&["bridge", "--json", flag, &at, "--config", &config]);
        assert_eq!(outcome.exit_code, Some(78), "{outcome}");
        let output = outcome.to_string();
        assert!(
            output.contains("old.pem") && output.contains("CN=robot expired at Jan  2 00:00:00 2024"),
            "{output}"
        );
        assert!(outcome.of_class("bridge_ready").is_empty(), "{outcome}");
    }
    assert!(check_finding(&env, &at, &config).contains("expired at Jan  2 00:00:00 2024"));
}
