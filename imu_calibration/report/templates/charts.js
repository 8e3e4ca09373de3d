(() => {
  const style = getComputedStyle(document.documentElement);
  const colour = name => style.getPropertyValue(name).trim();
  const COLOURS = {measured: '--ink', noise: '--faint', 'simulated before': '--before', before: '--before', 'simulated after': '--accent', after: '--accent'};
  const DASHES = {'simulated before': [6, 3], before: [6, 3], noise: [2, 3]};
  const sorted = data => {
    const order = [...data[0].keys()].filter(k => data[0][k] !== null).sort((a, b) => data[0][a] - data[0][b]);
    return data.map(column => order.map(k => column[k]));
  };
  const make = (place, chart) => {
    const points = chart.kind === 'points', log = chart.kind === 'log';
    const axis = label => ({label, stroke: colour('--grey'), grid: {stroke: colour('--line'), width: 1}, ticks: {stroke: colour('--line')},
                            font: '12px sans-serif', labelFont: '12px sans-serif'});
    const series = chart.names.map(name => ({
      label: name, stroke: colour(COLOURS[name]), width: 1.5, dash: points ? undefined : DASHES[name],
      paths: points ? () => null : chart.kind === 'steps' ? uPlot.paths.stepped({align: 1}) : undefined,
      points: {show: points, size: name === 'before' ? 5 : 3, fill: name === 'before' ? 'transparent' : colour(COLOURS[name])}}));
    return new uPlot({
      title: chart.title, width: place.clientWidth, height: 210, cursor: {drag: {x: true, y: true, uni: 20}},
      scales: {x: {time: false, distr: log ? 3 : 1}, y: {distr: log ? 3 : 1}},
      axes: [axis(chart.x), {...axis(), size: 58}], series: [{label: chart.x}, ...series]}, points ? sorted(chart.data) : chart.data, place);
  };
  for (const group of document.querySelectorAll('.charts')) {
    const charts = [...group.querySelectorAll('.chart')].map(place => {
      const chart = JSON.parse(place.dataset.chart);
      const draw = () => { place.replaceChildren(); make(place, chart); };
      draw();
      addEventListener('resize', draw);
      matchMedia('(prefers-color-scheme: dark)').addEventListener('change', draw);
      return {chart, draw};
    });
    group.querySelector('select')?.addEventListener('change', event => {
      for (const each of charts) {
        each.chart.data[0] = JSON.parse(group.dataset.variables)[event.target.value];
        each.chart.x = event.target.value;
        each.draw();
      }
    });
  }
})();
