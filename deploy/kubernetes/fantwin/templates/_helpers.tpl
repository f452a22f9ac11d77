{{- define "fantwin.labels" -}}
app.kubernetes.io/name: fantwin
app.kubernetes.io/instance: {{ .Release.Name }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version }}
{{- end }}

{{- /* What selects the pods of one part: (dict "root" $ "part" "scorer") */}}
{{- define "fantwin.selector" -}}
app.kubernetes.io/name: fantwin
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .part }}
{{- end }}

{{- /* The name of one part; names in Kubernetes have no underscores. */}}
{{- define "fantwin.name" -}}
{{ printf "%s-%s" .root.Release.Name (.part | replace "_" "-") | trunc 52 | trimSuffix "-" }}
{{- end }}

{{- /* The name of the set of a stage. The number of shards is in it: where that changes, every pod gets other trays. So a
new set takes the place of the old one; a rolling update would wait for pods that the old ones keep from starting. */}}
{{- define "fantwin.set" -}}
{{ printf "%s-%s" .root.Release.Name (.part | replace "_" "-") | trunc 44 | trimSuffix "-" }}-of-{{ .shards }}
{{- end }}

{{- define "fantwin.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}

{{- define "fantwin.endpoint" -}}
{{ .Values.router.endpoint | default (printf "tcp/%s:7447" (include "fantwin.name" (dict "root" . "part" "router"))) }}
{{- end }}

{{- define "fantwin.podSecurity" -}}
automountServiceAccountToken: false
{{- with .Values.image.pullSecrets }}
imagePullSecrets: {{- toYaml . | nindent 2 }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 1000
  runAsGroup: 1000
  fsGroup: 1000
  seccompProfile: {type: RuntimeDefault}
{{- end }}

{{- define "fantwin.containerSecurity" -}}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: {drop: [ALL]}
{{- end }}
