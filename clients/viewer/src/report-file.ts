// What `wildcity report` writes: report.json, and the pictures of report.html.

/** A report, as far as the viewer shows it. */
export interface Report {
  twin: string;
  version: number;
  places: ReportPlace[];
  settings: ReportSetting[];
}

/** Where settings were compared. */
export interface ReportPlace {
  name: string;
  /** Place along the first recorded drive, and to the left of it, in metres; undefined around a twin without a drive. */
  drive: { stationM: number; leftM: number } | undefined;
}

export interface ReportSetting {
  name: string;
  /** The PSNR of the worst camera at each place, in dB; Infinity without any error. */
  worstDb: number[];
}

/** The window in which a setting has its largest error. */
export interface WorstWindow {
  place: string;
  /** PNG files: as rendered, the reference, the map of errors. A setting without errors may have none. */
  files: Blob[];
}

/** Reads report.json. Throws if it is something else. */
export function parseReport(text: string): Report {
  let json: any;
  try {
    json = JSON.parse(text);
  } catch {
    throw new Error("report.json is not JSON");
  }
  const { subject, places, settings } = json ?? {};
  const isReport = typeof subject?.twin === "string" && Array.isArray(places) && Array.isArray(settings)
    && settings.every((setting) => setting?.by_place?.length === places.length);
  if (!isReport) throw new Error("this JSON is no report of wildcity report: it has no subject, places and settings");
  return {
    twin: subject.twin,
    version: subject.version,
    places: places.map((name: string) => ({ name, drive: parsePlace(name) })),
    settings: settings.map(({ name, by_place: byPlace }: any) => ({ name, worstDb: byPlace.map((result: any) => numberOf(result.least_db)) })),
  };
}

/** Numbers that JSON does not have are words in a report. */
const numberOf = (value: number | string): number => ({ inf: Infinity, "-inf": -Infinity, NaN: NaN })[value] ?? Number(value);

/** `71 m, 3 m left`. */
function parsePlace(name: string): ReportPlace["drive"] {
  const found = /^(-?[\d.]+) m(?:, ([\d.]+) m (left|right))?$/.exec(name);
  if (!found) return undefined;
  const [, station, offset = "0", side] = found;
  return { stationM: Number(station), leftM: side === "right" ? -Number(offset) : Number(offset) };
}

/** The worst windows of report.html, by the name of the setting. */
export function parseWindows(html: string): Map<string, WorstWindow> {
  const windows = new Map<string, WorstWindow>();
  for (const [, figure = ""] of html.matchAll(/<figure>(.*?)<\/figure>/gs)) {
    const [, name, place] = /<figcaption>(.*?), at (.*?)<\/figcaption>/s.exec(figure) ?? [];
    if (name === undefined || place === undefined) continue;
    const files = [...figure.matchAll(/src="data:image\/png;base64,([^"]*)"/g)].map(([, data]) =>
      new Blob([Uint8Array.from(atob(data!), (character) => character.charCodeAt(0))], { type: "image/png" }));
    windows.set(unescaped(name), { place: unescaped(place), files });
  }
  return windows;
}

const unescaped = (text: string): string =>
  text.replaceAll("&lt;", "<").replaceAll("&gt;", ">").replaceAll("&quot;", '"').replaceAll("&amp;", "&");
