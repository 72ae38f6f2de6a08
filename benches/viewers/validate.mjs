// What the Khronos validator says of GLB files: a line of JSON for each, in the order of the arguments.
import { readFile } from "node:fs/promises";
import { validateBytes } from "gltf-validator";

const SEVERITIES = ["error", "warning", "information", "hint"];

for (const path of process.argv.slice(2)) {
  const { issues } = await validateBytes(new Uint8Array(await readFile(path)), { maxIssues: 0 });
  const told = Object.fromEntries(SEVERITIES.map((name) => [name, {}]));
  for (const { severity, code } of issues.messages) {
    const codes = told[SEVERITIES[severity]];
    codes[code] = (codes[code] ?? 0) + 1;
  }
  console.log(JSON.stringify(told));
}
