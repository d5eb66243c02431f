"use strict";
// Unpacks compressed text of the page.
async function unpacked(id) {
  const raw = atob(document.getElementById(id).textContent.trim()), bytes = new Uint8Array(raw.length);
  for (let n = 0; n < raw.length; n += 1) { bytes[n] = raw.charCodeAt(n); }
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
}
