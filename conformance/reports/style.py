"""The style of the page."""

STYLE = """
:root { color-scheme: light dark;
  --paper: #fff; --card: #f6f7f9; --ink: #1b1f24; --muted: #59636e; --rule: #d5dae0; --grid: #e6e9ed;
  --good: #116329; --good-back: #dff3e4; --bad: #b3123a; --bad-back: #fde3e8; --known: #7a5200; --known-back: #fbeecb; }
@media (prefers-color-scheme: dark) { :root {
  --paper: #0f1318; --card: #181d24; --ink: #e6e9ed; --muted: #9aa5b1; --rule: #343b45; --grid: #262c35;
  --good: #6fd08c; --good-back: #15301f; --bad: #ff8094; --bad-back: #3d1822; --known: #f0c54a; --known-back: #352a0e;
    } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 1.5rem clamp(.8rem, 3vw, 2.5rem) 4rem; background: var(--paper);
  color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", "Liberation Sans", Arial, sans-serif;
    font-variant-numeric: tabular-nums; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2rem 0 .5rem; padding-top: .8rem; border-top: 1px solid var(--rule); }
h3 { font-size: 1rem; margin: 1.2rem 0 .2rem; overflow-wrap: anywhere; }
p { margin: .3rem 0 .8rem; max-width: 46rem; overflow-wrap: anywhere; }
a { color: inherit; text-decoration-color: var(--muted); text-underline-offset: .15em; }
.muted { color: var(--muted); } .small { font-size: .85rem; }
.good { color: var(--good); } .bad { color: var(--bad); } .known { color: var(--known); }
code, pre { font-family: ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace; font-size: .86em; }
code { overflow-wrap: anywhere; }
pre { white-space: pre-wrap; overflow-wrap: anywhere; background: var(--card); padding: .5rem .8rem; border-radius: 6px;
  margin: .3rem 0 .8rem; line-height: 1.45; }
td pre { background: none; padding: 0; margin: 0; max-height: 22rem; overflow-y: auto; }
.cards { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1rem 0; }
.card { background: var(--card); border-radius: 8px; padding: .7rem 1rem; border-left: 4px solid var(--muted);
  flex: 1 1 16rem; max-width: 26rem; min-width: 0; overflow-wrap: anywhere; }
.card.good { border-color: var(--good); } .card.bad { border-color: var(--bad); } .card { color: var(--ink); }
.card b { display: block; font-size: 1.7rem; line-height: 1.25; font-weight: 600; }
.card b small { font-size: 1rem; font-weight: 400; color: var(--muted); }
.card p { margin: 0; } .card ul { margin: .2rem 0; padding-left: 1.1rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; margin: .4rem 0 1rem; }
th, td { text-align: left; padding: .25rem .9rem .25rem 0; border-bottom: 1px solid var(--grid); vertical-align: top; }
th { font-weight: 600; } thead th { color: var(--muted); }
.matrix { width: 100%; } .matrix tbody th { white-space: nowrap; }
.matrix .cell { padding: .25rem .6rem; border-left: 3px solid var(--paper); width: 9rem; min-width: 6.5rem;
  overflow-wrap: anywhere; }
.overview { width: auto; } .overview .cell { width: auto; min-width: 9rem; max-width: 32rem; }
.matrix .text { color: var(--muted); font-size: .85rem; min-width: 15rem; padding-left: .8rem;
  overflow-wrap: anywhere; }
.cell.pass { background: var(--good-back); color: var(--good); }
.cell.fail { background: var(--bad-back); color: var(--bad); font-weight: 600; }
.cell.known { background: var(--known-back); color: var(--known); } .cell.none { color: var(--muted); }
.bar { display: block; height: 3px; margin-top: .15rem; border-radius: 2px; background: var(--grid); }
.bar span { display: block; height: 3px; border-radius: 2px; background: currentColor; }
details { margin: .4rem 0; } summary { cursor: pointer; overflow-wrap: anywhere; }
.box { border: 1px solid var(--rule); border-radius: 8px; padding: .5rem .9rem; min-width: 0; }
  .box > summary { font-weight: 600; }
.box.bad { border-left: 4px solid var(--bad); color: inherit; } .box.known { border-left: 4px solid var(--known);
  color: inherit; }
.diagnosis { background: var(--card); border-radius: 8px; padding: .6rem 1rem; margin: .6rem 0;
  border-left: 4px solid var(--known); }
.diagnosis p { margin: .1rem 0; }
.values td:first-child { white-space: nowrap; } .values td:nth-child(2) { white-space: nowrap; color: var(--muted);
  font-size: .85rem; }
@media (max-width: 40rem) { .overview tbody th { white-space: normal; } .overview { width: auto; }
.matrix .text { display: none; } .matrix .cell { min-width: 5.5rem; width: auto; }
  .values, .values tbody, .values tr, .values td { display: block; } .values td { border: 0; padding: 0; }
  .values tr { border-bottom: 1px solid var(--grid); padding: .3rem 0; }
    .values td:nth-child(2) { white-space: normal; } }
@media print { details:not([open]) > *:not(summary) { display: none; } }
"""
